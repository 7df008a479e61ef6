"""Shapes on the map, in metres: roads, waypoints, trails, bicycles and cars."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mo_deepdrive.drawing.quiet_pygame import gfxdraw, pygame
from mo_deepdrive.simulation.state import ARRIVAL_RADIUS, ARRIVED, LANE_WIDTH, LENGTH, MAP_CENTRE, RUNNING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mo_deepdrive.world.routes import Pose, Route

Colour = tuple[int, ...]  # red, green, blue and possibly alpha, each 0 to 255
Points = NDArray[np.float64]  # (points, 2), m

MAP_PIXELS = 720
SUPERSAMPLING = 2
DESTINATION_RADIUS = 1.8  # m, of the outer ring

GROUND, FINE_GRID, GRID = (232, 233, 228), (223, 225, 220), (207, 210, 205)
GRASS, KERB, ASPHALT = (176, 190, 160), (205, 205, 196), (72, 76, 84)
EDGE_LINE, CENTRE_LINE = (232, 232, 228), (236, 190, 74)
BLACK, WHITE, GREY, SHADOW, SHADOW_OFFSET = (0, 0, 0), (255, 255, 255), (190, 190, 190), (0, 0, 0, 45), (0.12, -0.16)
TYRE, GLASS, HEADLIGHT = (24, 26, 30), (34, 46, 62), (255, 244, 190)
TAIL_LIGHT, BRAKE_LIGHT, GLOW = (122, 22, 28), (255, 36, 40), (255, 36, 40, 90)
SIGNAL_LIGHT, SIGNAL_GLOW = (255, 176, 0), (255, 176, 0, 120)
TRAFFIC_PAINT = (222, 224, 228)  # of cars with scripted drivers
OBSTACLE, WARNING = (196, 30, 84), (196, 30, 84, 30)

CIRCLE = np.stack([np.cos(np.linspace(0.0, math.tau, 49)), np.sin(np.linspace(0.0, math.tau, 49))], axis=1)
TICK = np.array([(-0.5, 0.05), (-0.12, -0.38), (0.56, 0.46)])
# Right halves of a car's parts (m to the right of its centre, m in front of it).
NOSE = ((0.0, 2.588), (0.55, 2.55), (0.85, 2.42), (1.0, 2.12), (1.04, 1.2), (1.02, 0.0))
BODY = np.array([*NOSE, (1.04, -1.2), (1.0, -2.2), (0.86, -2.48), (0.55, -2.57), (0.0, -2.588)])
BONNET = np.array([(0.0, 2.34), (0.5, 2.3), (0.66, 1.05), (0.0, 1.05)])
CABIN = np.array([(0.0, 1.12), (0.5, 1.06), (0.86, 0.84), (0.86, -1.4), (0.72, -1.86), (0.0, -1.92)])
ROOF = np.array([(0.0, 0.3), (0.64, 0.24), (0.7, -0.2), (0.68, -1.1), (0.6, -1.3), (0.0, -1.34)])
ROOF_CENTRE, NUMBER_HEIGHT = np.array([0.0, -0.52]), 1.7  # m
FRONT_LAMP = np.array([(0.5, 2.5), (0.82, 2.4), (0.97, 2.08), (0.66, 2.2)])
REAR_LAMP = np.array([(0.46, -2.52), (0.84, -2.44), (0.98, -2.14), (0.8, -2.2), (0.46, -2.34)])
BRAKE_GLOW = (0.7, -2.5) + 0.55 * CIRCLE
SIGNAL_LAMPS = (
    np.array([(0.8, 2.46), (1.0, 2.12), (1.04, 1.6), (0.9, 1.9)]),
    np.array([(0.8, -2.5), (1.0, -2.2), (1.04, -1.7), (0.9, -2.0)]),
)
SIGNAL_GLOWS = ((0.95, 2.2) + 0.6 * CIRCLE, (0.95, -2.25) + 0.6 * CIRCLE)
MIRROR = np.array([(1.0, 0.92), (1.24, 0.82), (1.24, 0.66), (1.0, 0.7)])
WHEEL = np.array([(-0.15, 0.44), (0.15, 0.44), (0.15, -0.44), (-0.15, -0.44)])
FRONT_HUB, REAR_HUB = (0.98, 1.5), (0.98, -1.5)
SIDES = np.array([(1, 1), (-1, 1)])  # right, left
LEFT = SIDES[1]
# Deceleration (m/s^2) above which an oncoming car shows its braking lights: below it, a car that slows down without its
# brakes must not (UN Regulation No. 13-H, paragraph 5.2.22.4).
BRAKE_LIGHT_DECELERATION = 0.7
# The tubes of a bicycle that is 1 long (along it, above its axles): rear triangle, front triangle, fork, saddle.
FRAME = (
    np.array([(0.2, 0.0), (0.46, 0.0), (0.37, 0.26), (0.2, 0.0)]),
    np.array([(0.46, 0.0), (0.68, 0.26), (0.37, 0.26), (0.34, 0.34)]),
    np.array([(0.8, 0.0), (0.67, 0.38), (0.79, 0.38)]),
    np.array([(0.27, 0.35), (0.42, 0.35)]),
)


def mix(colour: Colour, other: Colour, share: float) -> Colour:
    """A mix of ``colour`` and ``other``, whose ``share`` is in [0, 1]."""
    return tuple(round(a + (b - a) * share) for a, b in zip(colour, other, strict=True))


def turned(points: Points, angle: float) -> Points:
    """``points`` rotated counter-clockwise by ``angle`` (rad) about the origin."""
    cos, sin = math.cos(angle), math.sin(angle)
    rotated: Points = points @ np.array([[cos, sin], [-sin, cos]])
    return rotated


class Canvas:
    """Draws in metres (x to the right, y up) on a surface that shows ``reach`` m to each side of the map's centre.

    Attributes:
        touched: rectangles of pixels that cover everything drawn so far; their sides are even.
    """

    def __init__(self, surface: pygame.Surface, reach: float):
        self.surface = surface
        self.reach = reach
        self.scale = MAP_PIXELS * SUPERSAMPLING / (2 * reach)  # pixels per metre
        self.touched: list[pygame.Rect] = []

    def pixels(self, points: ArrayLike) -> NDArray[np.int64]:
        """Pixels (points, 2) of ``points`` (points, 2)."""
        offset = (np.array(points) - MAP_CENTRE) * (self.scale, -self.scale) + MAP_PIXELS * SUPERSAMPLING / 2
        return np.rint(offset).astype(np.int64)

    def touch(self, area: pygame.Rect) -> None:
        """Record a rectangle that was drawn on; it is merged with one that it overlaps."""
        area = area.inflate(4, 4).clip(self.surface.get_rect())
        if not area:
            return  # nothing of it is on the surface
        left, top = area.left // SUPERSAMPLING * SUPERSAMPLING, area.top // SUPERSAMPLING * SUPERSAMPLING
        width, height = (-(-size // SUPERSAMPLING) * SUPERSAMPLING for size in (area.right - left, area.bottom - top))
        area = pygame.Rect(left, top, width, height)
        overlapped = area.collidelist(self.touched)
        if overlapped >= 0:
            self.touched[overlapped].union_ip(area)
        else:
            self.touched.append(area)

    def polygon(self, points: ArrayLike, colour: Colour) -> None:
        """A filled polygon, blended with the background if ``colour`` has an alpha."""
        corners = self.pixels(points)
        pixels = corners.tolist()
        gfxdraw.filled_polygon(self.surface, pixels, colour)
        if len(colour) == 3:
            gfxdraw.aapolygon(self.surface, pixels, colour)
        low, high = corners.min(axis=0), corners.max(axis=0)
        self.touch(pygame.Rect(low.tolist(), (high - low + 1).tolist()))

    def line(self, start: ArrayLike, end: ArrayLike, width: float, colour: Colour) -> None:
        """A straight line with blunt ends."""
        a, b = np.array(start), np.array(end)
        side = (b - a)[::-1] * (1, -1) * (width / 2 / max(math.dist(a, b), 1e-9))
        self.polygon([a - side, a + side, b + side, b - side], colour)

    def ring(self, centre: Points, radius: float, width: float, colour: Colour) -> None:
        """A ring of outer ``radius``; a disc if ``width`` equals it."""
        self.polygon(np.concatenate([centre + radius * CIRCLE, centre + (radius - width) * CIRCLE[::-1]]), colour)

    def grid(self) -> None:
        """A line every metre and a stronger one every five metres, unless they would be too dense."""
        low, high = math.floor(MAP_CENTRE - self.reach), math.ceil(MAP_CENTRE + self.reach)
        for step, colour in ((1, FINE_GRID), (5, GRID)):
            for k in range(low - low % step, high + 1, step) if step * self.scale > 8 * SUPERSAMPLING else ():
                self.line((k, low), (k, high), 1 / self.scale, colour)
                self.line((low, k), (high, k), 1 / self.scale, colour)

    def roads(self) -> None:
        """Two crossing roads with two lanes each; the lines end at the crossing."""
        far = self.reach + 1.0
        lines = [(side, LANE_WIDTH, far, EDGE_LINE) for side in (0.07 - LANE_WIDTH, LANE_WIDTH - 0.07)]
        lines += [(0.0, start, start + 1.5, CENTRE_LINE) for start in np.arange(LANE_WIDTH + 0.75, far, 3.0)]
        arms = [turned(np.eye(2), quarter * math.pi / 2) for quarter in range(4)]  # each: to its right, and outwards
        for width, surface in ((LANE_WIDTH + 0.4, KERB), (LANE_WIDTH, ASPHALT)):
            for _, out in arms:
                self.line(np.full(2, MAP_CENTRE), MAP_CENTRE + far * out, 2 * width, surface)
        for right, out in arms:
            for side, start, end, colour in lines:
                origin = MAP_CENTRE + side * right
                self.line(origin + start * out, origin + end * out, 0.14, colour)

    def strip(self, line: Sequence[Pose], width: float, colour: Colour) -> None:
        """A strip of road along poses (x, y, heading)."""
        poses = np.array(line)
        side = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1) * width / 2
        self.polygon(np.concatenate([poses[:, :2] + side, (poses[:, :2] - side)[::-1]]), colour)

    def lanes(self, routes: Sequence[Route]) -> None:
        """Roads of segments, with a line where those wait who have no right of way."""
        lines = [(route.lane_width, route.traced()) for route in routes]
        for more, colour in ((0.8, KERB), (0.0, EDGE_LINE), (-0.28, ASPHALT)):
            for width, line in lines:
                for piece in (line[k : k + 12] for k in range(0, len(line) - 1, 11)):  # none bends back on itself
                    self.strip(piece, width + more, colour)
        for route in routes:
            if route.priority is not None and route.priority[0] > 0.0:
                x, y, heading = route.traced(route.priority[0], 0.1)[0]
                right = np.array([math.cos(heading), math.sin(heading)])
                for side in np.arange(-route.lane_width / 2 + 0.6, route.lane_width / 2 - 0.3, 0.9):
                    self.line((x, y) + (side - 0.25) * right, (x, y) + (side + 0.25) * right, 0.3, EDGE_LINE)

    def way(self, route: Route, vehicle: Any, colour: Colour) -> None:
        """What is left of a vehicle's way along a route of segments, and its end."""
        left = route.traced(vehicle.route_distance)
        if vehicle.end == RUNNING and len(left) > 1:
            self.strip(left, 0.3, (*colour, 120))
        self.ring(
            np.array(route.joints()[-1][:2]), ARRIVAL_RADIUS, 0.3, (*colour, 255 if vehicle.end == RUNNING else 90)
        )

    def route(self, vehicle: Any, colour: Colour) -> None:
        """Waypoints: rings of the arrival radius; the next is filled, reached ones are ticked, the last has two."""
        reached = vehicle.n_waypoints if vehicle.end == ARRIVED else vehicle.next_waypoint
        for k, waypoint in enumerate(vehicle.waypoints[: vehicle.n_waypoints]):
            strength = 255 if k == reached else 150
            if k == reached:
                self.ring(waypoint, ARRIVAL_RADIUS, ARRIVAL_RADIUS, (*colour, 110))
            self.ring(waypoint, ARRIVAL_RADIUS, 0.16, (*colour, strength))
            if k == vehicle.n_waypoints - 1:
                self.ring(waypoint, DESTINATION_RADIUS, 0.3, (*colour, strength))
            if k < reached:
                for start, end in itertools.pairwise(waypoint + TICK):
                    self.line(start, end, 0.26, colour)
            else:
                self.ring(waypoint, 0.16, 0.16, (*colour, strength))

    def trail(self, positions: Points, colour: Colour, sheet: pygame.Surface) -> None:
        """A ribbon along ``positions`` (points, 2), oldest first, that gets wider and stronger towards the last one.

        It is drawn on ``sheet``, which is transparent, of the size of this surface, and cleared afterwards.
        """
        course = np.gradient(positions, axis=0)
        course /= np.maximum(np.hypot(course[:, 0], course[:, 1]), 1e-9)[:, None]
        recency = np.linspace(0.0, 1.0, len(positions))
        side = course[:, ::-1] * (-1, 1) * (0.15 + 0.3 * recency)[:, None]
        left, right = self.pixels(positions + side).tolist(), self.pixels(positions - side).tolist()
        pieces = []
        for k in range(len(positions) - 1):
            # Unlike gfxdraw, pygame.draw does not blend, so pieces that share an edge have no visible seam.
            corners = [left[k], right[k], right[k + 1], left[k + 1]]
            pieces.append(pygame.draw.polygon(sheet, (*colour, round(170 * recency[k])), corners))
        area = pieces[0].unionall(pieces[1:])
        self.surface.blit(sheet, area, area)
        sheet.fill((0, 0, 0, 0), area)
        self.touch(area)

    def bicycle(self, ends: Points) -> None:
        """A bicycle from ``ends[0]`` to ``ends[1]``; collisions are with the line between them."""
        along = ends[1] - ends[0]
        length = math.hypot(*along)
        axes = np.stack([along, (-along[1], along[0])])
        self.ring(ends.mean(axis=0), 0.5 * length + 0.5, 0.5 * length + 0.5, WARNING)
        self.line(ends[0], ends[1], 0.12, OBSTACLE)
        for hub in (0.2, 0.8):
            self.ring(ends[0] + hub * along, 0.2 * length, 0.055 * length, TYRE)
        for tube in FRAME:
            joints = ends[0] + np.dot(tube, axes)
            for start, end in itertools.pairwise(joints):
                self.line(start, end, 0.05 * length, TYRE)

    def vehicle(self, vehicle: Any, colour: Colour, number: int | None = None, *, signals: bool = False) -> None:
        """A vehicle, a record of VEHICLE, with its number on the roof if given; pale if its episode has ended.

        With ``signals`` its left turn signal is lit.
        """
        paint = colour if vehicle.end == RUNNING else mix(colour, GREY, 0.6)
        position = np.array([vehicle.x, vehicle.y])
        self._car(position, vehicle.heading, paint, steer=vehicle.steer, brakes=vehicle.brake > 0.0, signals=signals)
        if number is not None:
            self.number(number, position + turned(ROOF_CENTRE, vehicle.heading))

    def scripted_car(self, car: Any) -> None:
        """A car with a scripted driver, a record of dtype CAR; nothing if it is out of view."""
        # gfxdraw takes coordinates of 16 bits, and a car may be kilometres away.
        if abs(car.y - MAP_CENTRE) < self.reach + LENGTH:
            brakes = car.acceleration < -BRAKE_LIGHT_DECELERATION
            heading = math.atan2(car.sin_heading, car.cos_heading)
            self._car(np.array([car.x, car.y]), heading, TRAFFIC_PAINT, brakes=brakes)

    def _car(
        self,
        position: Points,
        heading: float,
        paint: Colour,
        *,
        brakes: bool,
        steer: float = 0.0,
        signals: bool = False,
    ) -> None:
        """A car with its centre at ``position`` (2,), whose braking lights and left turn signal may be lit."""
        glow, light = ([(BRAKE_GLOW, GLOW)], BRAKE_LIGHT) if brakes else ([], TAIL_LIGHT)
        trim, bonnet, roof = mix(paint, BLACK, 0.35), mix(paint, WHITE, 0.14), mix(paint, WHITE, 0.22)
        parts = [*glow, (BODY, trim), (BODY * (0.95, 0.98), paint), (BONNET, bonnet), (CABIN, GLASS), (ROOF, roof)]
        parts += [(MIRROR, trim), (FRONT_LAMP, HEADLIGHT), (REAR_LAMP, light), (WHEEL + REAR_HUB, TYRE)]
        shapes: list[tuple[Points, Colour]] = [(part * side, shade) for part, shade in parts for side in SIDES]
        # Both front wheels turn the same way, so they are not mirror images.
        shapes += [(turned(WHEEL, steer) + FRONT_HUB * side, TYRE) for side in SIDES]
        if signals:
            shapes = [(lamp * LEFT, SIGNAL_GLOW) for lamp in SIGNAL_GLOWS] + shapes
            shapes += [(lamp * LEFT, SIGNAL_LIGHT) for lamp in SIGNAL_LAMPS]
        for spread in (1.02, 1.07):
            outline = np.concatenate([BODY, (BODY * LEFT)[::-1]]) * spread
            self.polygon(turned(outline, heading) + position + SHADOW_OFFSET, SHADOW)
        for shape, shade in shapes:
            self.polygon(position + turned(shape, heading), shade)

    def number(self, number: int, centre: Points) -> None:
        """An upright number, drawn on top."""
        pygame.font.init()
        image = pygame.font.Font(None, round(NUMBER_HEIGHT * self.scale)).render(str(number), True, TYRE)
        self.surface.blit(image, image.get_rect(center=self.pixels([centre])[0].tolist()))
