"""Pictures of a world: a map seen from above beside a panel of readings.

Nothing here moves or measures anything: a :class:`Viewer` reads the state of one world and remembers, for the trail
and the sums, what it has been shown of the episode. Everything is drawn at twice its size and scaled down, which
smooths every edge, on surfaces in memory; only ``render_mode="human"`` needs a display.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mo_deepdrive.config import EnvConfig
from mo_deepdrive.objectives import INDEX, OBJECTIVES
from mo_deepdrive.scenarios import MAP_CENTRE, MAP_SIZE, SCENARIOS
from mo_deepdrive.simulation.params import chosen_objectives
from mo_deepdrive.simulation.state import ARRIVAL_RADIUS, ARRIVED, ENDS, LANE_WIDTH, MAX_WAYPOINTS, RUNNING, TIME_LIMIT

with contextlib.redirect_stdout(io.StringIO()):  # pygame greets on import; standard output belongs to the program
    import pygame
    from pygame import gfxdraw

Colour = tuple[int, ...]  # red, green, blue and possibly alpha, each 0 to 255
Points = NDArray[np.float64]  # (points, 2), m

RENDER_MODES = ("rgb_array", "human")
MAP_PIXELS = 720
PANEL_PIXELS = 336
FRAME_SIZE = (MAP_PIXELS + PANEL_PIXELS, MAP_PIXELS)  # multiples of 16, as video encoders want them
SUPERSAMPLING = 2
TRAIL_SECONDS = 5.0
VEHICLE_MARGIN = 3.0  # m that are visible around a vehicle's centre: more than half its diagonal
DESTINATION_RADIUS = 1.8  # m, of the ring that makes it stand out

GROUND, FINE_GRID, GRID = (232, 233, 228), (223, 225, 220), (207, 210, 205)
GRASS, KERB, ASPHALT = (176, 190, 160), (205, 205, 196), (72, 76, 84)
EDGE_LINE, CENTRE_LINE = (232, 232, 228), (236, 190, 74)
VEHICLE_COLOURS = ((38, 116, 232), (240, 126, 38))
BLACK, WHITE, GREY, SHADOW, SHADOW_OFFSET = (0, 0, 0), (255, 255, 255), (190, 190, 190), (0, 0, 0, 45), (0.12, -0.16)
TYRE, GLASS, HEADLIGHT = (24, 26, 30), (34, 46, 62), (255, 244, 190)
TAIL_LIGHT, BRAKE_LIGHT, GLOW = (122, 22, 28), (255, 36, 40), (255, 36, 40, 90)
OBSTACLE, WARNING = (196, 30, 84), (196, 30, 84, 30)
PANEL, TILE, RULE, TEXT, DIM = (24, 28, 36), (36, 42, 53), (54, 62, 76), (240, 243, 248), (150, 160, 176)
FAILURE, END_COLOURS = (204, 58, 62), {RUNNING: TILE, ARRIVED: (38, 150, 92), TIME_LIMIT: (170, 122, 34)}
READINGS = (("speed", "m/s"), ("g_force", "g"), ("jerk", "m/s³"), ("route_distance", "m"))  # fields and units

CIRCLE = np.stack([np.cos(np.linspace(0.0, math.tau, 49)), np.sin(np.linspace(0.0, math.tau, 49))], axis=1)
# Right halves of a car's parts (m to the right, m ahead of its centre).
NOSE = ((0.0, 2.588), (0.55, 2.55), (0.85, 2.42), (1.0, 2.12), (1.04, 1.2), (1.02, 0.0))
BODY = np.array([*NOSE, (1.04, -1.2), (1.0, -2.2), (0.86, -2.48), (0.55, -2.57), (0.0, -2.588)])
BONNET = np.array([(0.0, 2.34), (0.5, 2.3), (0.66, 1.05), (0.0, 1.05)])
CABIN = np.array([(0.0, 1.12), (0.5, 1.06), (0.86, 0.84), (0.86, -1.4), (0.72, -1.86), (0.0, -1.92)])
ROOF = np.array([(0.0, 0.3), (0.64, 0.24), (0.7, -0.2), (0.68, -1.1), (0.6, -1.3), (0.0, -1.34)])
FRONT_LAMP = np.array([(0.5, 2.5), (0.82, 2.4), (0.97, 2.08), (0.66, 2.2)])
REAR_LAMP = np.array([(0.46, -2.52), (0.84, -2.44), (0.98, -2.14), (0.8, -2.2), (0.46, -2.34)])
BRAKE_GLOW = (0.7, -2.5) + 0.55 * CIRCLE
MIRROR = np.array([(1.0, 0.92), (1.24, 0.82), (1.24, 0.66), (1.0, 0.7)])
WHEEL = np.array([(-0.15, 0.44), (0.15, 0.44), (0.15, -0.44), (-0.15, -0.44)])
FRONT_HUB, REAR_HUB = (0.98, 1.5), (0.98, -1.5)
SIDES = np.array([(1, 1), (-1, 1)])  # right, left
# The tubes of a bicycle that is 1 long (along it, above its axles): rear triangle, front triangle, fork, saddle.
FRAME = (
    np.array([(0.2, 0.0), (0.46, 0.0), (0.37, 0.26), (0.2, 0.0)]),
    np.array([(0.46, 0.0), (0.68, 0.26), (0.37, 0.26), (0.34, 0.34)]),
    np.array([(0.8, 0.0), (0.67, 0.38), (0.79, 0.38)]),
    np.array([(0.27, 0.35), (0.42, 0.35)]),
)


def mix(colour: Colour, other: Colour, share: float) -> Colour:
    """``colour`` with a ``share`` in [0, 1] of ``other``."""
    return tuple(round(a + (b - a) * share) for a, b in zip(colour, other, strict=True))


def turned(points: Points, angle: float) -> Points:
    """``points`` turned counter-clockwise by ``angle`` (rad) about the origin."""
    cos, sin = math.cos(angle), math.sin(angle)
    rotated: Points = points @ np.array([[cos, sin], [-sin, cos]])
    return rotated


def titled(name: str) -> str:
    """A name of the code as people write it."""
    return name.replace("_", " ").capitalize()


def reach_of(world: NDArray[Any]) -> float:
    """How far (m) from the map's centre to look: the map, and as far beyond as vehicles and waypoints lie."""
    reaches = [MAP_SIZE / 2]
    for vehicle in world:
        reaches.append(max(abs(vehicle.x - MAP_CENTRE), abs(vehicle.y - MAP_CENTRE)) + VEHICLE_MARGIN)
        reaches.extend(np.abs(vehicle.waypoints[: vehicle.n_waypoints] - MAP_CENTRE).ravel() + DESTINATION_RADIUS)
    return float(max(reaches))


class Canvas:
    """Draws in metres (x to the right, y up) on a surface that shows ``reach`` m to each side of the map's centre."""

    def __init__(self, surface: pygame.Surface, reach: float):
        self.surface = surface
        self.reach = reach
        self.scale = MAP_PIXELS * SUPERSAMPLING / (2 * reach)  # pixels per metre

    def pixels(self, points: ArrayLike) -> list[tuple[int, int]]:
        """Pixels of ``points`` (points, 2)."""
        offset = (np.array(points) - MAP_CENTRE) * (self.scale, -self.scale) + MAP_PIXELS * SUPERSAMPLING / 2
        return [(round(x), round(y)) for x, y in offset]

    def polygon(self, points: ArrayLike, colour: Colour) -> None:
        """A filled polygon, blended with what is below it if ``colour`` has an alpha."""
        pixels = self.pixels(points)
        gfxdraw.filled_polygon(self.surface, pixels, colour)
        if len(colour) == 3:
            gfxdraw.aapolygon(self.surface, pixels, colour)

    def line(self, start: ArrayLike, end: ArrayLike, width: float, colour: Colour) -> None:
        """A straight line with blunt ends."""
        a, b = np.array(start), np.array(end)
        side = (b - a)[::-1] * (1, -1) * (width / 2 / max(math.dist(a, b), 1e-9))
        self.polygon([a - side, a + side, b + side, b - side], colour)

    def ring(self, centre: Points, radius: float, width: float, colour: Colour) -> None:
        """A ring of outer ``radius``; a disc if it is as wide."""
        self.polygon(np.concatenate([centre + radius * CIRCLE, centre + (radius - width) * CIRCLE[::-1]]), colour)

    def grid(self) -> None:
        """A line for every metre and a stronger one for every fifth; none where they would lie too densely."""
        low, high = math.floor(MAP_CENTRE - self.reach), math.ceil(MAP_CENTRE + self.reach)
        for step, colour in ((1, FINE_GRID), (5, GRID)):
            for k in range(low - low % step, high + 1, step) if step * self.scale > 8 * SUPERSAMPLING else ():
                self.line((k, low), (k, high), 1 / self.scale, colour)
                self.line((low, k), (high, k), 1 / self.scale, colour)

    def roads(self) -> None:
        """Two crossing roads of two lanes; their lines break at the crossing."""
        far = self.reach + 1.0
        lines = [(side, LANE_WIDTH, far, EDGE_LINE) for side in (0.07 - LANE_WIDTH, LANE_WIDTH - 0.07)]
        lines += [(0.0, start, start + 1.5, CENTRE_LINE) for start in np.arange(LANE_WIDTH + 0.75, far, 3.0)]
        arms = [turned(np.eye(2), quarter * math.pi / 2) for quarter in range(4)]  # each: its right and its way out
        for width, surface in ((LANE_WIDTH + 0.4, KERB), (LANE_WIDTH, ASPHALT)):
            for _, out in arms:
                self.line(np.full(2, MAP_CENTRE), MAP_CENTRE + far * out, 2 * width, surface)
        for right, out in arms:
            for side, start, end, colour in lines:
                origin = MAP_CENTRE + side * right
                self.line(origin + start * out, origin + end * out, 0.14, colour)

    def route(self, vehicle: Any, colour: Colour) -> None:
        """Waypoints: rings of the arrival radius, the next one filled, passed ones faint, the last one ringed twice."""
        for k, waypoint in enumerate(vehicle.waypoints[: vehicle.n_waypoints]):
            strength = 255 if k == vehicle.next_waypoint else 150 if k > vehicle.next_waypoint else 60
            if k == vehicle.next_waypoint:
                self.ring(waypoint, ARRIVAL_RADIUS, ARRIVAL_RADIUS, (*colour, 110))
            self.ring(waypoint, 0.16, 0.16, (*colour, strength))
            self.ring(waypoint, ARRIVAL_RADIUS, 0.16, (*colour, strength))
            if k == vehicle.n_waypoints - 1:
                self.ring(waypoint, DESTINATION_RADIUS, 0.3, (*colour, strength))

    def trail(self, positions: Points, colour: Colour) -> None:
        """A ribbon along ``positions`` (points, 2), oldest first, that widens and gains colour towards the last."""
        course = np.gradient(positions, axis=0)
        course /= np.maximum(np.hypot(course[:, 0], course[:, 1]), 1e-9)[:, None]
        youth = np.linspace(0.0, 1.0, len(positions))
        side = course[:, ::-1] * (-1, 1) * (0.15 + 0.3 * youth)[:, None]
        left, right = positions + side, positions - side
        for k in range(len(positions) - 1):
            # Unlike gfxdraw, pygame.draw replaces what is below: pieces that share an edge show no seam.
            piece = self.pixels([left[k], right[k], right[k + 1], left[k + 1]])
            pygame.draw.polygon(self.surface, (*colour, round(170 * youth[k])), piece)

    def bicycle(self, ends: Points) -> None:
        """A bicycle lying from ``ends[0]`` to ``ends[1]``; the line between them is what can be hit."""
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

    def vehicle(self, vehicle: Any, colour: Colour) -> None:
        """A car; pale when its episode has ended."""
        paint = colour if vehicle.end == RUNNING else mix(colour, GREY, 0.6)
        glow, light = ([(BRAKE_GLOW, GLOW)], BRAKE_LIGHT) if vehicle.brake > 0.0 else ([], TAIL_LIGHT)
        trim, bonnet, roof = mix(paint, BLACK, 0.35), mix(paint, WHITE, 0.14), mix(paint, WHITE, 0.22)
        parts = [*glow, (BODY, trim), (BODY * (0.95, 0.98), paint), (BONNET, bonnet), (CABIN, GLASS), (ROOF, roof)]
        parts += [(MIRROR, trim), (FRONT_LAMP, HEADLIGHT), (REAR_LAMP, light), (WHEEL + REAR_HUB, TYRE)]
        shapes: list[tuple[Points, Colour]] = [(part * side, shade) for part, shade in parts for side in SIDES]
        # Both front wheels turn the same way: they are no mirror images.
        shapes += [(turned(WHEEL, vehicle.steer) + FRONT_HUB * side, TYRE) for side in SIDES]
        position = np.array([vehicle.x, vehicle.y])
        for spread in (1.02, 1.07):
            outline = np.concatenate([BODY, (BODY * SIDES[1])[::-1]]) * spread
            self.polygon(turned(outline, vehicle.heading) + position + SHADOW_OFFSET, SHADOW)
        for shape, shade in shapes:
            self.polygon(position + turned(shape, vehicle.heading), shade)


class Panel:
    """Writes beside the map, in pixels of the finished frame from the panel's upper left corner."""

    def __init__(self, surface: pygame.Surface, enlarged: float):
        pygame.font.init()  # and fonts anew for every picture: other environments shut pygame down when they close
        self._surface = surface
        self._enlarged = enlarged
        self._fonts: dict[int, pygame.font.Font] = {}
        self.rectangle(0, 0, PANEL_PIXELS, MAP_PIXELS, PANEL)

    def rectangle(self, left: float, top: float, width: float, height: float, colour: Colour, radius: int = 0) -> None:
        sides = [round(SUPERSAMPLING * side) for side in (MAP_PIXELS + left, top, width, height)]
        pygame.draw.rect(self._surface, colour, sides, border_radius=radius * SUPERSAMPLING)

    def write(self, text: str, x: float, y: float, size: int, colour: Colour, fill: Colour | None = None) -> float:
        """Write ``text`` about the height ``y`` from ``x`` on, or up to -``x`` if negative; ``fill`` is a label's."""
        if size not in self._fonts:
            self._fonts[size] = pygame.font.Font(None, round(size * SUPERSAMPLING * self._enlarged))
        picture = self._fonts[size].render(text, True, colour)
        width, height = picture.get_width() / SUPERSAMPLING, picture.get_height() / SUPERSAMPLING
        left = x if x >= 0 else -x - width
        if fill is not None:
            self.rectangle(left - 10, y - 0.8 * height, width + 20, 1.6 * height, fill, radius=16)
        self._surface.blit(picture, ((MAP_PIXELS + left) * SUPERSAMPLING, (y - height / 2) * SUPERSAMPLING))
        return left + width


class Episode:
    """What a viewer remembers of the episode it is shown, per vehicle."""

    def __init__(self, vehicles: int, trail_length: int):
        self.trails = [deque[tuple[float, float]](maxlen=trail_length) for _ in range(vehicles)]  # m, oldest first
        self.sums = np.zeros((vehicles, len(INDEX)))  # magnitudes of the decisions shown
        self.complete = np.ones(vehicles, dtype=np.bool_)  # whether those are all decisions so far
        self._decisions = np.zeros(vehicles, dtype=np.int64)
        self._along = np.full((vehicles, MAX_WAYPOINTS), np.nan)

    def follow(self, world: NDArray[Any]) -> None:
        """Take in ``world`` (vehicles,); to take in the same state again changes nothing."""
        decisions, along = world["decisions"].copy(), world["along"].copy()
        begins = not decisions.any()
        # Who shows only some decisions may first show a new episode when it is older than the last one was.
        if begins or (decisions < self._decisions).any() or not np.array_equal(along, self._along):
            self.sums[:] = 0.0
            self.complete[:] = True
            self._decisions[:] = -1 if begins else 0
            for trail in self.trails:
                trail.clear()
        new = decisions - self._decisions
        self.complete &= new <= 1
        self.sums[new > 0] += world["objectives"][new > 0]
        for v in np.flatnonzero(new):
            self.trails[v].append((float(world[v].x), float(world[v].y)))
        self._decisions, self._along = decisions, along


class Viewer:
    """Draws one world of ``config``.

    Args:
        config: the environment's configuration.
        render_mode: "rgb_array", or "human" to show every picture in a window, too, at decision_frequency.

    Raises:
        ValueError: for another render_mode.
    """

    def __init__(self, config: EnvConfig, render_mode: str):
        if render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode = {render_mode!r} must be one of {list(RENDER_MODES)}")
        self.config = config
        self.render_mode = render_mode
        self.scenario = SCENARIOS[config.scenario]
        self.objectives = chosen_objectives(config)
        self._episode = Episode(self.scenario.vehicles, 1 + round(TRAIL_SECONDS * config.decision_frequency))
        width, height = (SUPERSAMPLING * size for size in FRAME_SIZE)
        self._surface = pygame.Surface((width, height), 0, 32)
        self._ground = Canvas(pygame.Surface((height, height), 0, 32), math.inf)
        self._trails = pygame.Surface((height, height), pygame.SRCALPHA, 32)
        self._frame = pygame.Surface(FRAME_SIZE, 0, 32)
        self._clock = pygame.time.Clock()
        self._dismissed = False

    def draw(self, world: NDArray[Any]) -> NDArray[np.uint8]:
        """The picture of ``world`` (vehicles,) of dtype VEHICLE: a new RGB array (height, width, 3).

        Under "human" it is shown, too, until the user closes the window.
        """
        self._episode.follow(world)
        self._draw_map(world)
        self._draw_panel(world)
        pygame.transform.smoothscale(self._surface, FRAME_SIZE, self._frame)
        if self.render_mode == "human" and not self._dismissed:
            self._show()
        return pygame.surfarray.pixels3d(self._frame).transpose(1, 0, 2).copy()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.render_mode == "human":
            pygame.display.quit()

    def _show(self) -> None:
        pygame.display.init()
        window = pygame.display.get_surface()
        if window is None:
            window = pygame.display.set_mode(FRAME_SIZE)
            pygame.display.set_caption(f"MO-DeepDrive: {self.scenario.title}")
        window.blit(self._frame, (0, 0))
        pygame.display.flip()
        self._clock.tick(self.config.decision_frequency)
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self._dismissed = True
            self.close()

    def _draw_map(self, world: NDArray[Any]) -> None:
        reach = reach_of(world)
        if reach != self._ground.reach:  # what stands still is drawn once per view
            self._ground = Canvas(self._ground.surface, reach)
            self._ground.surface.fill(GRASS if self.scenario.lanes else GROUND)
            if self.scenario.lanes:
                self._ground.roads()
            else:
                self._ground.grid()
        self._surface.blit(self._ground.surface, (0, 0))
        canvas, ribbons = Canvas(self._surface, reach), Canvas(self._trails, reach)
        self._trails.fill((0, 0, 0, 0))
        for vehicle, positions, colour in zip(world, self._episode.trails, VEHICLE_COLOURS, strict=False):
            canvas.route(vehicle, colour)
            if len(positions) > 1:
                ribbons.trail(np.array(positions), colour)
        self._surface.blit(self._trails, (0, 0))
        if self.scenario.obstacle:
            canvas.bicycle(world[0].obstacle)
        # A vehicle that has ended has left the road: the other one drives over it.
        for v in np.argsort(world["end"] == RUNNING, kind="stable"):
            canvas.vehicle(world[v], VEHICLE_COLOURS[v])

    def _draw_panel(self, world: NDArray[Any]) -> None:
        alone = len(world) == 1
        pitch = 1.6 if alone else 1.0  # how far heights are spread
        panel = Panel(self._surface, 1.15 if alone else 1.0)
        panel.write(self.scenario.title, 20, 34, 34, TEXT)
        panel.write(f"{world['decisions'].max() / self.config.decision_frequency:.1f} s", -316, 34, 34, TEXT)
        panel.rectangle(20, 60, 296, 1, RULE)
        for v, vehicle in enumerate(world):
            top = 72.0 + 322.0 * v
            row = top + 12 * pitch
            end = titled(ENDS[vehicle.end]) or "Driving"
            panel.rectangle(20, row - 7, 14, 14, VEHICLE_COLOURS[v], radius=4)
            panel.write("Vehicle" if alone else f"Vehicle {v + 1}", 44, row, 24, TEXT)
            panel.write(end, -306, row, 20, TEXT, END_COLOURS.get(int(vehicle.end), FAILURE))
            for k, (field, unit) in enumerate(READINGS):
                left, upper = 20 + 152 * (k % 2), top + (32 + 48 * (k // 2)) * pitch
                panel.rectangle(left, upper, 144, 42 * pitch, TILE, radius=6)
                panel.write(titled(field), left + 10, upper + 12 * pitch, 18, DIM)
                panel.write(f"{vehicle[field]:,.2f}", left + 10, upper + 29 * pitch, 26, TEXT)
                panel.write(unit, -(left + 134), upper + 29 * pitch, 18, DIM)
            for text, x in (("Objective", 20), ("this decision", -226), ("episode", -316)):
                panel.write(text, x, top + 142 * pitch, 18, DIM)
            for k, name in enumerate(self.objectives):
                row, index = top + (164 + 22 * k) * pitch, INDEX[name]
                unit = OBJECTIVES[index].unit.replace("^3", "³")
                panel.rectangle(20, row - 11 * pitch, 296, 1, RULE)
                name_end = panel.write(titled(name), 20, row, 21, TEXT)
                panel.write("" if unit == "1" else unit, name_end + 6, row + 1, 16, DIM)
                panel.write(f"{vehicle.objectives[index]:,.2f}", -226, row, 21, TEXT)
                total = f"{self._episode.sums[v, index]:,.2f}" if self._episode.complete[v] else "—"
                panel.write(total, -316, row, 21, TEXT)
