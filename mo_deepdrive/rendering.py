"""Pictures of a world: a map seen from above beside a panel of readings.

Nothing here moves or measures anything: a :class:`Viewer` reads the state of one world and remembers, for the trail
and for the sums, what it has been shown of the episode. Everything is drawn at twice its size and scaled down, which
smooths every edge, on a surface in memory; only ``render_mode="human"`` needs a display.
"""

from __future__ import annotations

import contextlib
import io
import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mo_deepdrive.config import EnvConfig
from mo_deepdrive.objectives import INDEX, OBJECTIVES
from mo_deepdrive.scenarios import MAP_CENTRE, MAP_SIZE, SCENARIOS
from mo_deepdrive.simulation.params import chosen_objectives
from mo_deepdrive.simulation.state import ARRIVAL_RADIUS, ARRIVED, ENDS, LANE_WIDTH, LENGTH, RUNNING, TIME_LIMIT

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
VIEW_MARGIN = LENGTH  # m between a vehicle's centre and the edge of the picture

GROUND, FINE_GRID, GRID = (232, 233, 228), (223, 225, 220), (207, 210, 205)
GRASS, KERB, ASPHALT = (176, 190, 160), (205, 205, 196), (72, 76, 84)
EDGE_LINE, CENTRE_LINE = (232, 232, 228), (236, 190, 74)
VEHICLE_COLOURS = ((38, 116, 232), (240, 126, 38))
TYRE, GLASS = (24, 26, 30), (34, 46, 62)
HEADLIGHT, TAIL_LIGHT, BRAKE_LIGHT = (255, 244, 190), (122, 22, 28), (255, 36, 40)
SHADOW = (0, 0, 0, 45)
BICYCLE, BICYCLE_FRAME, WARNING = (30, 32, 36), (200, 40, 90), (200, 40, 90, 34)
PANEL, TILE, RULE = (24, 28, 36), (36, 42, 53), (54, 62, 76)
TEXT, DIM = (240, 243, 248), (150, 160, 176)
GOOD, BAD, NEUTRAL = (38, 150, 92), (204, 58, 62), (170, 122, 34)

# Half outlines (m to the right, m ahead of the centre), front to rear; the other half mirrors them.
BODY = ((0.0, 2.588), (0.55, 2.55), (0.85, 2.42), (1.0, 2.12), (1.04, 1.2), (1.02, 0.0), (1.04, -1.2), (1.0, -2.2))
BODY += ((0.86, -2.48), (0.55, -2.57), (0.0, -2.588))
CABIN = ((0.0, 1.12), (0.5, 1.06), (0.86, 0.84), (0.86, -1.4), (0.72, -1.86), (0.0, -1.92))
ROOF = ((0.0, 0.3), (0.64, 0.24), (0.7, -0.2), (0.68, -1.1), (0.6, -1.3), (0.0, -1.34))
# Parts of the right side; the left side mirrors them.
HEADLIGHT_SHAPE = ((0.5, 2.5), (0.82, 2.4), (0.97, 2.08), (0.66, 2.2))
TAIL_LIGHT_SHAPE = ((0.46, -2.52), (0.84, -2.44), (0.98, -2.14), (0.8, -2.2), (0.46, -2.34))
MIRROR = ((1.0, 0.92), (1.24, 0.82), (1.24, 0.66), (1.0, 0.7))
WHEEL = ((-0.17, 0.46), (0.17, 0.46), (0.17, -0.46), (-0.17, -0.46))
WHEEL_SIDE, WHEEL_AHEAD = 0.96, 1.52
HOOD = ((-0.66, 1.05), (-0.5, 2.3), (0.5, 2.3), (0.66, 1.05))
# Bars (start, end, width) of a bicycle of 1.8 m that points ahead, from the lowest to the highest.
BICYCLE_BARS: tuple[tuple[tuple[float, float], tuple[float, float], float, Colour], ...] = (
    ((0.0, -0.85), (0.0, -0.25), 0.1, BICYCLE),
    ((0.0, 0.25), (0.0, 0.85), 0.1, BICYCLE),
    ((-0.2, -0.08), (0.2, 0.08), 0.07, BICYCLE),
    ((0.0, -0.45), (0.0, 0.5), 0.12, BICYCLE_FRAME),
    ((-0.32, 0.36), (0.32, 0.36), 0.08, BICYCLE),
    ((0.0, -0.42), (0.0, -0.22), 0.2, BICYCLE),
)


def mix(colour: Colour, other: Colour, share: float) -> Colour:
    """``colour`` with ``share`` in [0, 1] of ``other``."""
    return tuple(round(a + (b - a) * share) for a, b in zip(colour[:3], other[:3], strict=True))


def mirrored(half: ArrayLike) -> Points:
    """The closed outline of which ``half`` (points, 2) is the right side."""
    right = np.array(half, dtype=np.float64)
    return np.concatenate([right, right[::-1] * (-1, 1)])


def turned(points: ArrayLike, angle: float) -> Points:
    """``points`` (points, 2) turned counter-clockwise by ``angle`` (rad) about the origin."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array(points, dtype=np.float64) @ np.array([[cos, sin], [-sin, cos]])


def arc(start: float, end: float) -> Points:
    """Points (25, 2) on the unit circle between two angles (rad)."""
    angles = np.linspace(start, end, 25)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def title(name: str) -> str:
    """A name of the code as people write it: "harmful_g_force" becomes "Harmful g-force"."""
    words = name.replace("g_force", "g-force").replace("_", " ")
    return words[:1].upper() + words[1:]


def number(value: float) -> str:
    """``value`` with fewer decimals the larger it is."""
    return f"{value:,.{2 if abs(value) < 100 else 1 if abs(value) < 1000 else 0}f}"


@dataclass(frozen=True)
class Camera:
    """Which square of the world the map shows: its lower left corner (m) and the canvas pixels per metre."""

    left: float = 0.0
    bottom: float = 0.0
    scale: float = MAP_PIXELS * SUPERSAMPLING / MAP_SIZE

    @property
    def side(self) -> float:
        """Side of the visible square (m)."""
        return MAP_PIXELS * SUPERSAMPLING / self.scale

    @classmethod
    def showing(cls, world: NDArray[Any]) -> Camera:
        """The whole map, widened about its centre as far as vehicles and waypoints beyond it require."""
        reach = MAP_SIZE / 2
        for vehicle in world:
            seen = np.vstack([(vehicle.x, vehicle.y), vehicle.waypoints[: vehicle.n_waypoints]])
            reach = max(reach, float(np.abs(seen - MAP_SIZE / 2).max()) + VIEW_MARGIN)
        return cls(MAP_SIZE / 2 - reach, MAP_SIZE / 2 - reach, MAP_PIXELS * SUPERSAMPLING / (2 * reach))


class Canvas:
    """Draws on ``surface`` in metres (x to the right, y up) as ``camera`` sees them."""

    def __init__(self, surface: pygame.Surface, camera: Camera):
        self.surface = surface
        self.camera = camera

    def pixels(self, points: ArrayLike) -> list[tuple[int, int]]:
        """Canvas pixels of ``points`` (points, 2) in m."""
        offset = (np.asarray(points) - (self.camera.left, self.camera.bottom)) * self.camera.scale
        return [(round(x), MAP_PIXELS * SUPERSAMPLING - round(y)) for x, y in offset]

    def polygon(self, points: ArrayLike, colour: Colour) -> None:
        """A filled polygon, blended with what is below where ``colour`` has an alpha."""
        pixels = self.pixels(points)
        gfxdraw.filled_polygon(self.surface, pixels, colour)
        if len(colour) == 3:
            gfxdraw.aapolygon(self.surface, pixels, colour)

    def box(self, left: float, bottom: float, right: float, top: float, colour: Colour) -> None:
        self.polygon([(left, bottom), (right, bottom), (right, top), (left, top)], colour)

    def disc(self, centre: ArrayLike, radius: float, colour: Colour) -> None:
        self.polygon(centre + radius * arc(0.0, math.tau), colour)

    def ring(self, centre: ArrayLike, radius: float, width: float, colour: Colour) -> None:
        """A ring whose middle line has ``radius`` (m)."""
        round_trip = arc(0.0, math.tau)
        sides = (centre + (radius + width / 2) * round_trip, centre + (radius - width / 2) * round_trip[::-1])
        self.polygon(np.concatenate(sides), colour)

    def bar(self, start: Points, end: Points, width: float, colour: Colour) -> None:
        """A straight line with round ends, ``width`` m wide."""
        along = end - start
        angle = math.atan2(along[1], along[0])
        cap = width / 2 * arc(angle - math.pi / 2, angle + math.pi / 2)
        self.polygon(np.concatenate([end + cap, start - cap]), colour)


class Episode:
    """What a viewer remembers of the episode it is shown.

    Attributes:
        trails: per vehicle its latest positions (m), oldest first.
        sums: (vehicles, objectives) summed magnitudes.
        complete: (vehicles,) whether every decision so far has been shown, and the sums hold for the episode.
    """

    def __init__(self, vehicles: int, trail_length: int):
        self.trails = [deque[tuple[float, float]](maxlen=trail_length) for _ in range(vehicles)]
        self.sums = np.zeros((vehicles, len(INDEX)))
        self.complete = np.ones(vehicles, dtype=np.bool_)
        self._decisions = np.zeros(vehicles, dtype=np.int64)
        self._along: NDArray[np.float64] | None = None

    def follow(self, world: NDArray[Any]) -> None:
        """Take in ``world`` (vehicles,); a state that has been taken in already changes nothing."""
        decisions, along = world["decisions"], world["along"]
        # A viewer that is not shown every decision may first see a new episode after as many decisions as the last.
        if not decisions.any() or (decisions < self._decisions).any() or not np.array_equal(along, self._along):
            self.sums[:] = 0.0
            self.complete[:] = True
            self._decisions[:] = -1 if not decisions.any() else 0
            for trail in self.trails:
                trail.clear()
        new = decisions > self._decisions
        self.complete &= decisions - self._decisions <= 1
        self.sums[new] += world["objectives"][new]
        for v in np.flatnonzero(new):
            self.trails[v].append((float(world[v].x), float(world[v].y)))
        self._decisions, self._along = decisions.copy(), along.copy()


class Viewer:
    """Draws one world of ``config``.

    Args:
        config: the environment's configuration.
        render_mode: "rgb_array", or "human" to show every picture in a window as well, at decision_frequency.

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
        self._ground = pygame.Surface((height, height), 0, 32)
        self._trails = pygame.Surface((height, height), pygame.SRCALPHA, 32)
        self._frame = pygame.Surface(FRAME_SIZE, 0, 32)
        self._ground_camera: Camera | None = None
        self._clock = pygame.time.Clock()
        self._dismissed = False

    def draw(self, world: NDArray[Any]) -> NDArray[np.uint8]:
        """The picture of ``world`` (vehicles,) of dtype VEHICLE: a new RGB array (height, width, 3).

        Under "human" it is shown, too, unless the user has closed the window.
        """
        self._episode.follow(world)
        camera = Camera.showing(world)
        canvas = Canvas(self._surface, camera)
        self._draw_ground(camera)
        self._surface.blit(self._ground, (0, 0))
        for vehicle, colour in zip(world, VEHICLE_COLOURS, strict=False):
            draw_route(canvas, vehicle, colour)
        self._draw_trails(camera)
        if self.scenario.obstacle:
            draw_bicycle(canvas, world[0].obstacle)
        # A vehicle that has ended is off the road: the other one drives over it.
        for v in sorted(range(len(world)), key=lambda v: world[v].end == RUNNING):
            draw_vehicle(canvas, world[v], VEHICLE_COLOURS[v])
        draw_scale(canvas)
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
        pygame.event.pump()
        if pygame.event.get(pygame.QUIT):
            self._dismissed = True
            self.close()
            return
        pygame.display.flip()
        self._clock.tick(self.config.decision_frequency)

    def _draw_ground(self, camera: Camera) -> None:
        """Bring the picture of everything that stands still in line with ``camera``."""
        if camera == self._ground_camera:
            return
        self._ground_camera = camera
        canvas = Canvas(self._ground, camera)
        if self.scenario.lanes:
            self._ground.fill(GRASS)
            draw_roads(canvas)
        else:
            self._ground.fill(GROUND)
            draw_grid(canvas)

    def _draw_trails(self, camera: Camera) -> None:
        """Ribbons that widen and gain colour towards the vehicles."""
        canvas = Canvas(self._trails, camera)
        self._trails.fill((0, 0, 0, 0))
        for trail, colour in zip(self._episode.trails, VEHICLE_COLOURS, strict=False):
            points = np.array(trail)
            if len(points) < 2:
                continue
            course = np.gradient(points, axis=0)
            course /= np.maximum(np.hypot(course[:, 0], course[:, 1]), 1e-9)[:, None]
            age = np.linspace(1.0, 0.0, len(points))
            side = course[:, ::-1] * (-1, 1) * (0.45 - 0.3 * age)[:, None]
            for k in range(len(points) - 1):
                quad = [points[k] - side[k], points[k] + side[k], points[k + 1] + side[k + 1], points[k + 1] - side[k + 1]]
                # Pieces share their edges: drawn with replacement, unlike gfxdraw's blending, they leave no seams.
                pygame.draw.polygon(self._trails, (*colour, round(170 * (1 - age[k]))), canvas.pixels(quad))
        self._surface.blit(self._trails, (0, 0))

    def _draw_panel(self, world: NDArray[Any]) -> None:
        """The readings beside the map."""
        panel = Panel(self._surface)
        seconds = world["decisions"].max() / self.config.decision_frequency
        panel.write(self.scenario.title, 20, 34, 34, TEXT)
        panel.write(f"{seconds:.1f} s", 316, 34, 34, TEXT, align=1.0)
        panel.rectangle(20, 60, 296, 1, RULE)
        pitch = 1.35 if len(world) == 1 else 1.0
        for v, vehicle in enumerate(world):
            self._draw_readings(panel, v, vehicle, 72.0 + 322.0 * v, pitch)

    def _draw_readings(self, panel: Panel, v: int, vehicle: Any, top: float, pitch: float) -> None:
        """The readings of vehicle ``v`` from ``top`` (pixels) down, with all heights scaled by ``pitch``."""
        middle = top + 12 * pitch
        name = "Vehicle" if self.scenario.vehicles == 1 else f"Vehicle {v + 1}"
        panel.rectangle(20, middle - 7, 14, 14, VEHICLE_COLOURS[v], radius=4)
        panel.write(name, 44, middle, 24, TEXT)
        end = title(ENDS[vehicle.end]) if vehicle.end != RUNNING else "Driving"
        colours = {RUNNING: TILE, ARRIVED: GOOD, TIME_LIMIT: NEUTRAL}
        width = panel.width(end, 20) + 20
        panel.rectangle(316 - width, middle - 12, width, 24, colours.get(vehicle.end, BAD), radius=12)
        panel.write(end, 306, middle, 20, DIM if vehicle.end == RUNNING else TEXT, align=1.0)
        readings = (
            ("Speed", number(vehicle.speed), "m/s"),
            ("G-force", number(vehicle.g_force), "g"),
            ("Jerk", number(vehicle.jerk), "m/s³"),
            ("Route distance", number(vehicle.route_distance), "m"),
        )
        for k, (label, value, unit) in enumerate(readings):
            left, upper = 20 + 152 * (k % 2), top + (32 + 48 * (k // 2)) * pitch
            panel.rectangle(left, upper, 144, 42 * pitch, TILE, radius=6)
            panel.write(label, left + 10, upper + 12 * pitch, 18, DIM)
            panel.write(value, left + 10, upper + 29 * pitch, 26, TEXT)
            panel.write(unit, left + 134, upper + 29 * pitch, 18, DIM, align=1.0)
        row = top + 142 * pitch
        for text, right in (("this decision", 220), ("episode", 316)):
            panel.write(text, right, row, 18, DIM, align=1.0)
        panel.write("Objective", 20, row, 18, DIM)
        for k, objective in enumerate(self.objectives):
            row = top + (164 + 22 * k) * pitch
            magnitude, total = vehicle.objectives[INDEX[objective]], self._episode.sums[v, INDEX[objective]]
            unit = OBJECTIVES[INDEX[objective]].unit.replace("^3", "³")
            panel.rectangle(20, row - 11 * pitch, 296, 1, RULE)
            end_of_name = 20 + panel.write(title(objective), 20, row, 21, TEXT)
            if unit != "1":
                panel.write(unit, end_of_name + 6, row + 1, 16, DIM)
            panel.write(number(magnitude), 220, row, 21, TEXT, align=1.0)
            panel.write(number(total) if self._episode.complete[v] else "—", 316, row, 21, TEXT, align=1.0)


class Panel:
    """Writes on the part of ``surface`` to the right of the map, in pixels of the finished frame."""

    def __init__(self, surface: pygame.Surface):
        pygame.font.init()  # anew for every picture: other environments shut pygame down when they close
        self._surface = surface
        self._fonts: dict[int, pygame.font.Font] = {}
        self.rectangle(0, 0, PANEL_PIXELS, MAP_PIXELS, PANEL)

    def _font(self, size: int) -> pygame.font.Font:
        if size not in self._fonts:
            self._fonts[size] = pygame.font.Font(None, size * SUPERSAMPLING)
        return self._fonts[size]

    def width(self, text: str, size: int) -> float:
        return self._font(size).size(text)[0] / SUPERSAMPLING

    def rectangle(self, left: float, top: float, width: float, height: float, colour: Colour, radius: int = 0) -> None:
        sides = [round(SUPERSAMPLING * side) for side in (MAP_PIXELS + left, top, width, height)]
        pygame.draw.rect(self._surface, colour, sides, border_radius=radius * SUPERSAMPLING)

    def write(self, text: str, x: float, y: float, size: int, colour: Colour, align: float = 0.0) -> float:
        """Write ``text`` with its middle at height ``y``, from ``x`` on (or up to it: ``align`` = 1); its width."""
        picture = self._font(size).render(text, True, colour)
        corner = (MAP_PIXELS + x) * SUPERSAMPLING - align * picture.get_width(), y * SUPERSAMPLING - picture.get_height() / 2
        self._surface.blit(picture, corner)
        return picture.get_width() / SUPERSAMPLING


def draw_grid(canvas: Canvas) -> None:
    """A line for every metre and a stronger one for every fifth."""
    first, last = math.floor(canvas.camera.left), math.ceil(canvas.camera.left + canvas.camera.side)
    for step, colour in ((1, FINE_GRID), (5, GRID)):
        if step * canvas.camera.scale < 8 * SUPERSAMPLING:
            continue
        half = 0.5 / canvas.camera.scale
        for k in range(first - first % step, last + 1, step):
            canvas.box(k - half, first, k + half, last, colour)
            canvas.box(first, k - half, last, k + half, colour)


def draw_roads(canvas: Canvas) -> None:
    """Two crossing roads of two lanes; their lines break at the crossing."""
    reach = canvas.camera.side / 2 + 1.0
    for width, colour in ((LANE_WIDTH + 0.4, KERB), (LANE_WIDTH, ASPHALT)):
        for half in ((width, reach), (reach, width)):
            canvas.box(*(MAP_CENTRE - np.array(half)), *(MAP_CENTRE + np.array(half)), colour)
    for quarter in range(4):
        lines = [(side - 0.07, LANE_WIDTH, side + 0.07, reach, EDGE_LINE) for side in (0.1 - LANE_WIDTH, LANE_WIDTH - 0.1)]
        starts = np.arange(LANE_WIDTH + 0.75, reach, 3.0)
        lines += [(-0.07, start, 0.07, start + 1.5, CENTRE_LINE) for start in starts]
        for left, bottom, right, top, colour in lines:
            corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
            canvas.polygon(MAP_CENTRE + turned(corners, quarter * math.pi / 2), colour)


def draw_route(canvas: Canvas, vehicle: Any, colour: Colour) -> None:
    """The waypoints of a vehicle: rings of the arrival radius, the next one filled, the destination ringed twice."""
    for k, waypoint in enumerate(vehicle.waypoints[: vehicle.n_waypoints]):
        following = k == vehicle.next_waypoint
        strength = 255 if following else 150 if k > vehicle.next_waypoint else 60
        if following:
            canvas.disc(waypoint, ARRIVAL_RADIUS, (*colour, 110))
        canvas.ring(waypoint, ARRIVAL_RADIUS, 0.16, (*colour, strength))
        canvas.disc(waypoint, 0.16, (*colour, strength))
        if k == vehicle.n_waypoints - 1:
            canvas.ring(waypoint, 1.8 * ARRIVAL_RADIUS, 0.3, (*colour, strength))


def draw_bicycle(canvas: Canvas, ends: Points) -> None:
    """A bicycle from above, from ``ends[0]`` to ``ends[1]`` (m): only the line between them can be hit."""
    length = float(np.hypot(*(ends[1] - ends[0])))
    angle = math.atan2(ends[1][1] - ends[0][1], ends[1][0] - ends[0][0]) - math.pi / 2
    middle = (ends[0] + ends[1]) / 2
    canvas.disc(middle, length / 2 + 0.6, WARNING)
    # Drawn for a bicycle of 1.8 m and stretched along, up to a point across.
    scale = np.array([min(length / 1.8, 1.7), length / 1.8])
    for start, end, width, colour in BICYCLE_BARS:
        a, b = (middle + turned(scale * point, angle) for point in (start, end))
        canvas.bar(a, b, width * scale[0], colour)


def draw_vehicle(canvas: Canvas, vehicle: Any, colour: Colour) -> None:
    """A car from above; pale when its episode has ended."""
    paint = colour if vehicle.end == RUNNING else mix(colour, (190, 190, 190), 0.6)
    position, heading = np.array([vehicle.x, vehicle.y]), vehicle.heading

    def part(points: ArrayLike, part_colour: Colour) -> None:
        canvas.polygon(position + turned(points, heading), part_colour)

    body = mirrored(BODY)
    for spread in (1.02, 1.07):
        canvas.polygon(position + (0.12, -0.16) + turned(body * spread, heading), SHADOW)
    part(body, mix(paint, (0, 0, 0), 0.35))
    part(body * (0.95, 0.98), paint)
    part(HOOD, mix(paint, (255, 255, 255), 0.14))
    part(mirrored(CABIN), GLASS)
    part(mirrored(ROOF), mix(paint, (255, 255, 255), 0.22))
    braking = vehicle.brake > 0.0
    for side in (-1, 1):
        part(np.array(MIRROR) * (side, 1), mix(paint, (0, 0, 0), 0.35))
        part(np.array(HEADLIGHT_SHAPE) * (side, 1), HEADLIGHT)
        if braking:
            canvas.disc(position + turned((side * 0.7, -2.5), heading), 0.55, (*BRAKE_LIGHT, 90))
        part(np.array(TAIL_LIGHT_SHAPE) * (side, 1), BRAKE_LIGHT if braking else TAIL_LIGHT)
        for ahead, angle in ((WHEEL_AHEAD, vehicle.steer), (-WHEEL_AHEAD, 0.0)):
            part(turned(WHEEL, angle) + (side * WHEEL_SIDE, ahead), TYRE)


def draw_scale(canvas: Canvas) -> None:
    """How long five metres are."""
    left, bottom = (corner + 0.025 * canvas.camera.side for corner in (canvas.camera.left, canvas.camera.bottom))
    canvas.box(left, bottom, left + 5.0, bottom + 0.004 * canvas.camera.side, TYRE)
