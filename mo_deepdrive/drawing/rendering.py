"""Frames of a world: a map seen from above, and a panel of readings.

A :class:`Viewer` reads the state of one world. For trails and sums it keeps the decisions drawn so far in the episode.
Everything is drawn at twice the size and scaled down, which smooths edges, on surfaces in memory; only
``render_mode="human"`` needs a display. Static parts are drawn and scaled once.
"""

from __future__ import annotations

import math
import warnings
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.drawing.canvas import DESTINATION_RADIUS, GRASS, GROUND, MAP_PIXELS, SUPERSAMPLING, Canvas, Colour
from mo_deepdrive.drawing.quiet_pygame import INVISIBLE_DRIVERS, pygame
from mo_deepdrive.simulation.kernel import batch_rewards
from mo_deepdrive.simulation.state import (
    ARRIVED,
    ENDS,
    MAP_CENTRE,
    MAP_SIZE,
    MAX_WAYPOINTS,
    OTHER_VEHICLE,
    RUNNING,
    TIME_LIMIT,
)
from mo_deepdrive.world.measures import make_measures
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES, signs
from mo_deepdrive.world.params import chosen_objectives, make_params

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.world.config import EnvConfig
    from mo_deepdrive.world.routes import Route

RENDER_MODES = ("rgb_array", "human")
PANEL_PIXELS = 336
FRAME_SIZE = (MAP_PIXELS + PANEL_PIXELS, MAP_PIXELS)  # multiples of 16, which video encoders need
TRAIL_SECONDS = 5.0
VEHICLE_MARGIN = 3.0  # m visible around a vehicle's centre; more than half its diagonal
FLASHES = 1.5  # of a turn signal per second (UN Regulation No. 48, paragraph 6.5.9.1: 90 +- 30 per minute)

VEHICLE_COLOURS = (
    *((38, 116, 232), (240, 126, 38), (46, 160, 84), (214, 52, 92), (142, 86, 214), (0, 164, 180), (196, 160, 0)),
    *((232, 110, 180), (120, 84, 56), (84, 104, 140), (148, 190, 40), (250, 156, 120), (110, 60, 130), (0, 112, 96)),
    *((160, 160, 170), (150, 20, 30)),
)
PANEL, TILE, RULE, TEXT, DIM = (24, 28, 36), (36, 42, 53), (54, 62, 76), (240, 243, 248), (150, 160, 176)
FAILURE, NEUTRAL = (204, 58, 62), (96, 106, 124)
END_COLOURS = {RUNNING: TILE, ARRIVED: (38, 150, 92), TIME_LIMIT: (170, 122, 34), OTHER_VEHICLE: NEUTRAL}
READINGS = (  # fields, labels and units
    ("speed", "Speed", "m/s"),
    ("g_force", "G force", "g"),
    ("jerk", "Jerk", "m/s³"),
    ("route_distance", "Along the route", "m"),
)


def titled(name: str) -> str:
    """A name in the code as a title: "lane_violation" as "Lane violation"."""
    return name.replace("_", " ").capitalize()


def reward_text(value: float) -> str:
    """A reward with two digits, never "-0.00"."""
    return f"{round(float(value), 2) + 0.0:,.2f}"


def reach_of(world: NDArray[Any], roads: Sequence[Route] = ()) -> float:
    """Visible distance (m) from the map's centre: at least the map or all roads, and all vehicles and waypoints."""
    if roads:
        joints = np.array([joint for route in roads for joint in route.joints()])
        return float(np.abs(joints[:, :2] - MAP_CENTRE).max()) + VEHICLE_MARGIN
    reaches = [MAP_SIZE / 2]
    for vehicle in world:
        reaches.append(max(abs(vehicle.x - MAP_CENTRE), abs(vehicle.y - MAP_CENTRE)) + VEHICLE_MARGIN)
        reaches.extend(np.abs(vehicle.waypoints[: vehicle.n_waypoints] - MAP_CENTRE).ravel() + DESTINATION_RADIUS)
    return float(max(reaches))


def signals_left(vehicle: Any) -> bool:
    """Whether a vehicle has its left turn signal on: until it is on the last leg of a route that turns left."""
    last = vehicle.n_waypoints - 1
    if vehicle.next_waypoint >= last:
        return False
    x, y = vehicle.waypoints[last] - vehicle.waypoints[last - 1]
    leftward = -x * math.cos(vehicle.start_heading) - y * math.sin(vehicle.start_heading)
    return bool(leftward > 0.5 * math.hypot(x, y))


class Panel:
    """The readings beside the map; their labels are drawn once.

    Readings are magnitudes; rewards have the signs that the environment gives them (``reward_signs``, per objective).
    Positions are in pixels of the final frame, from the panel's upper left corner.
    """

    def __init__(
        self,
        title: str,
        objectives: tuple[str, ...],
        reward_signs: NDArray[np.float64],
        vehicles: int,
        decision_frequency: int,
    ):
        self._title = title
        self._objectives = objectives
        self._signs = reward_signs
        self._vehicles = vehicles
        self._decision_frequency = decision_frequency
        self._alone = vehicles == 1
        self._many = vehicles > 2
        self._spacing = min(44.0, 620.0 / vehicles)  # of the rows of many vehicles
        self._pitch = 1.6 if self._alone else 1.0  # factor of vertical distances
        self._row = min(22.0, (230.0 if self._alone else 158.0) / len(objectives))  # height of an objective
        self._fonts: dict[int, pygame.font.Font] = {}
        self._surface = pygame.Surface((PANEL_PIXELS, MAP_PIXELS), 0, 32)
        self._labels: pygame.Surface | None = None

    def draw(self, world: NDArray[Any], trace: EpisodeTrace) -> pygame.Surface:
        """The panel for ``world`` (vehicles,)."""
        pygame.font.init()  # and new fonts for every frame: other environments quit pygame when they close
        self._fonts.clear()
        if self._labels is None:
            self._draw_labels()
            self._labels = self._surface.copy()
        self._surface.blit(self._labels, (0, 0))
        self._write(f"{world['decisions'].max() / self._decision_frequency:.1f} s", -316, 34, 34, TEXT)
        for v, vehicle in enumerate(world):
            if self._many:
                self._draw_row(v, vehicle)
            else:
                self._draw_readings(v, vehicle, trace)
        return self._surface

    def _draw_row(self, v: int, vehicle: Any) -> None:
        """The speed of one of many vehicles and what remains of its route, or how it ended."""
        row = 86 + self._spacing * v
        if vehicle.end == RUNNING:
            self._write(f"{vehicle.speed:,.1f} m/s", -220, row, 20, TEXT)
            self._write(f"{vehicle.route_distance:,.0f} m", -306, row, 20, DIM)
        else:
            end = f"{titled(ENDS[vehicle.end])}, {vehicle.decisions / self._decision_frequency:.1f} s"
            self._write(end, -306, row, 20, TEXT, END_COLOURS.get(int(vehicle.end), FAILURE))

    def _height(self, v: int, offset: float) -> float:
        """Vertical position of a point ``offset`` below the top of the section of vehicle ``v``."""
        return 72.0 + 322.0 * v + offset * self._pitch

    def _tile(self, v: int, k: int) -> tuple[float, float]:
        """Left and upper edge of the tile of the ``k``-th reading."""
        return 20 + 152 * (k % 2), self._height(v, 32 + 48 * (k // 2))

    def _draw_labels(self) -> None:
        self._surface.fill(PANEL)
        self._write(self._title, 20, 34, 34, TEXT)
        self._rectangle(20, 60, 296, 1, RULE)
        for v in range(self._vehicles if self._many else 0):
            row = 86 + self._spacing * v
            self._rectangle(20, row - 7, 14, 14, VEHICLE_COLOURS[v], radius=4)
            self._write(f"Vehicle {v}", 44, row, 20, TEXT)
        for v in range(0 if self._many else self._vehicles):
            row = self._height(v, 12)
            self._rectangle(20, row - 7, 14, 14, VEHICLE_COLOURS[v], radius=4)
            self._write("Vehicle" if self._alone else f"Vehicle {v}", 44, row, 24, TEXT)
            for k, (_, name, unit) in enumerate(READINGS):
                left, upper = self._tile(v, k)
                self._rectangle(left, upper, 144, 42 * self._pitch, TILE, radius=6)
                self._write(name, left + 10, upper + 12 * self._pitch, 18, DIM)
                self._write(unit, -(left + 134), upper + 29 * self._pitch, 18, DIM)
            for text, x in (("Reward", 20), ("this decision", -226), ("episode", -316)):
                self._write(text, x, self._height(v, 142), 18, DIM)
            for k, name in enumerate(self._objectives):
                row = self._height(v, 164 + self._row * k)
                unit = OBJECTIVES[INDEX[name]].unit.replace("^2", "²").replace("^3", "³")
                self._rectangle(20, row - 11 * self._pitch, 296, 1, RULE)
                name_end = self._write(titled(name), 20, row, 21, TEXT)
                if unit != "1":
                    self._write(unit, name_end + 6, row + 1, 16, DIM)

    def _draw_readings(self, v: int, vehicle: Any, trace: EpisodeTrace) -> None:
        end = titled(ENDS[vehicle.end]) or "Driving"
        if vehicle.end != RUNNING and not self._alone:  # where the other vehicle may still drive
            end += f", {vehicle.decisions / self._decision_frequency:.1f} s"
        self._write(end, -306, self._height(v, 12), 20, TEXT, END_COLOURS.get(int(vehicle.end), FAILURE))
        for k, (field, *_) in enumerate(READINGS):
            left, upper = self._tile(v, k)
            self._write(f"{vehicle[field]:,.2f}", left + 10, upper + 29 * self._pitch, 26, TEXT)
        for k, sign in enumerate(self._signs):
            row = self._height(v, 164 + self._row * k)
            self._write(reward_text(sign * trace.magnitudes[v, k]), -226, row, 21, TEXT)
            total = reward_text(sign * trace.sums[v, k]) if trace.complete[v] else "—"
            self._write(total, -316, row, 21, TEXT)

    def _rectangle(self, left: float, top: float, width: float, height: float, colour: Colour, radius: int = 0) -> None:
        """A rectangle with smooth round corners."""
        large = pygame.Surface((round(width) * SUPERSAMPLING, round(height) * SUPERSAMPLING), pygame.SRCALPHA, 32)
        large.fill((*colour, 0))
        pygame.draw.rect(large, colour, large.get_rect(), border_radius=radius * SUPERSAMPLING)
        self._surface.blit(pygame.transform.smoothscale_by(large, 1 / SUPERSAMPLING), (round(left), round(top)))

    def _write(self, text: str, x: float, y: float, size: int, colour: Colour, fill: Colour | None = None) -> float:
        """Write ``text`` centred vertically at ``y``, from ``x`` on, or up to -``x`` if ``x`` is negative.

        With the colour ``fill`` there is a label behind the text. Returns the right end.
        """
        if size not in self._fonts:
            self._fonts[size] = pygame.font.Font(None, round(size * SUPERSAMPLING * (1.15 if self._alone else 1.0)))
        large = self._fonts[size].render(text, True, colour)
        image = pygame.transform.smoothscale_by(large, 1 / SUPERSAMPLING)
        width, height = image.get_size()
        left = x if x >= 0 else -x - width
        if fill is not None:
            self._rectangle(left - 10, y - 0.8 * height, width + 20, 1.6 * height, fill, radius=16)
        self._surface.blit(image, (round(left), round(y - height / 2)))
        return left + width


class EpisodeTrace:
    """The part of an episode that a viewer was shown, per vehicle."""

    def __init__(self, vehicles: int, objectives: int, trail_length: int):
        self.trails = [deque[tuple[float, float]](maxlen=trail_length) for _ in range(vehicles)]  # m, oldest first
        self.magnitudes = np.zeros((vehicles, objectives))  # of the last decision shown
        self.sums = np.zeros((vehicles, objectives))  # of the magnitudes of the decisions shown
        self.complete = np.ones(vehicles, dtype=np.bool_)  # whether these are all decisions so far
        self._decisions = np.zeros(vehicles, dtype=np.int64)
        self._along = np.full((vehicles, MAX_WAYPOINTS), np.nan)

    def follow(self, world: NDArray[Any], magnitudes: NDArray[np.float64]) -> None:
        """Add the state ``world`` (vehicles,) and its ``magnitudes`` (vehicles, objectives).

        Adding the same state again changes nothing.
        """
        decisions, along = world["decisions"].copy(), world["along"].copy()
        begins = not decisions.any()
        # If only some decisions are shown, those of a new episode may begin later than the previous one ended.
        if begins or (decisions < self._decisions).any() or not np.array_equal(along, self._along):
            self.sums[:] = 0.0
            self.complete[:] = True
            self._decisions[:] = -1 if begins else 0
            for trail in self.trails:
                trail.clear()
        new = decisions - self._decisions
        self.complete &= new <= 1
        self.magnitudes = magnitudes
        self.sums[new > 0] += magnitudes[new > 0]
        for v in np.flatnonzero(new):
            self.trails[v].append((float(world[v].x), float(world[v].y)))
        self._decisions, self._along = decisions, along


class Viewer:
    """Draws one world of ``config``.

    With "human" it also shows every frame in a window, at decision_frequency. Another mode than RENDER_MODES is a
    ValueError.
    """

    def __init__(self, config: EnvConfig, render_mode: str):
        if render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode = {render_mode!r} must be one of {list(RENDER_MODES)}")
        self.config = config
        self.render_mode = render_mode
        self.scenario = config.scenario_data
        self._roads = self.scenario.routes if self.scenario.roads else ()
        self.objectives = chosen_objectives(config)
        # With this sign the rewards are the magnitudes.
        self._params = make_params(config.model_copy(update={"cost_sign": "paper"}))
        self._write_rewards = batch_rewards(make_measures(config))
        trail_length = 1 + round(TRAIL_SECONDS * config.decision_frequency)
        self._trace = EpisodeTrace(self.scenario.vehicles, len(self.objectives), trail_length)
        reward_signs = signs(self.objectives) if config.cost_sign == "maximise" else np.ones(len(self.objectives))
        self._panel = Panel(
            self.scenario.title, self.objectives, reward_signs, self.scenario.vehicles, config.decision_frequency
        )
        large = (MAP_PIXELS * SUPERSAMPLING, MAP_PIXELS * SUPERSAMPLING)
        self._ground = Canvas(pygame.Surface(large, 0, 32), math.inf)
        self._small_ground = pygame.Surface((MAP_PIXELS, MAP_PIXELS), 0, 32)
        self._map = pygame.Surface(large, 0, 32)  # the ground; while drawing, with everything on it
        self._sheet = pygame.Surface(large, pygame.SRCALPHA, 32)
        self._frame = pygame.Surface(FRAME_SIZE, 0, 32)
        self._clock = pygame.time.Clock()
        self._dismissed = False

    def draw(self, world: NDArray[Any]) -> NDArray[np.uint8]:
        """The frame of ``world`` (vehicles,) of dtype VEHICLE: a new RGB array (height, width, 3).

        With "human" it is also shown in the window, unless the user has closed it or there is no display. Of pygame's
        events only QUIT is taken; a user's program gets the others.
        """
        self._trace.follow(world, self._magnitudes(world))
        self._draw_map(world)
        self._frame.blit(self._panel.draw(world, self._trace), (MAP_PIXELS, 0))
        if self.render_mode == "human" and not self._dismissed:
            self._show()
        pixels = np.frombuffer(bytearray(pygame.image.tobytes(self._frame, "RGB")), dtype=np.uint8)
        return pixels.reshape(FRAME_SIZE[1], FRAME_SIZE[0], 3)

    def _magnitudes(self, world: NDArray[Any]) -> NDArray[np.float64]:
        """The magnitudes (vehicles, objectives) of the last decision; zero for vehicles that had ended before."""
        decisions = world["decisions"]
        acted = (decisions > 0) & (decisions == decisions.max())
        magnitudes = np.zeros((len(world), len(self.objectives)))
        self._write_rewards(world[None], self._params, acted[None], magnitudes[None])
        return magnitudes

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.render_mode == "human":
            pygame.display.quit()

    def _show(self) -> None:
        try:
            window = self._window()
        except pygame.error as error:
            self._warn_of_no_window(f"SDL says {str(error)!r}")
            self._dismissed = True
            return
        window.blit(self._frame, (0, 0))
        pygame.display.flip()
        self._clock.tick(self.config.decision_frequency)
        if pygame.event.get(pygame.QUIT):
            self._dismissed = True
            self.close()

    def _window(self) -> pygame.Surface:
        pygame.display.init()
        window = pygame.display.get_surface()
        if window is None:
            window = pygame.display.set_mode(FRAME_SIZE)
            pygame.display.set_caption(f"MO-DeepDrive: {self.scenario.title}")
            if (driver := pygame.display.get_driver()) in INVISIBLE_DRIVERS:
                self._warn_of_no_window(f"SDL has only {driver!r}")
        return window

    @staticmethod
    def _warn_of_no_window(reason: str) -> None:
        warnings.warn(f"render_mode='human' has no display and shows no window ({reason})", stacklevel=2)

    def _draw_map(self, world: NDArray[Any]) -> None:
        reach = reach_of(world, self._roads)
        if reach != self._ground.reach:
            self._draw_ground(reach)
        canvas = Canvas(self._map, reach)
        for vehicle, positions, colour in zip(world, self._trace.trails, VEHICLE_COLOURS, strict=False):
            if self._roads:
                canvas.way(self._roads[vehicle.route], vehicle, colour)
            else:
                canvas.route(vehicle, colour)
            if len(positions) > 1:
                canvas.trail(np.array(positions), colour, self._sheet)
        for k in range(self.scenario.obstacles):
            canvas.bicycle(world[0].obstacle[2 * k : 2 * k + 2])
        for car in world[0].cars:
            if car.present:
                canvas.scripted_car(car)
        # A vehicle that has ended is off the road: others are drawn on top of it, and where there are many it is gone.
        order = np.argsort(world["end"] == RUNNING, kind="stable")
        for v in order if len(world) <= 2 else order[world["end"][order] == RUNNING]:
            number = int(v) if len(world) > 1 else None
            canvas.vehicle(world[v], VEHICLE_COLOURS[v], number, signals=self._signal_is_lit(world[v]))
        self._frame.blit(self._small_ground, (0, 0))
        for area in canvas.touched:
            small = pygame.Rect(*(side // SUPERSAMPLING for side in area))
            pygame.transform.smoothscale(self._map.subsurface(area), small.size, self._frame.subsurface(small))
        for area in canvas.touched:
            self._map.blit(self._ground.surface, area, area)

    def _signal_is_lit(self, vehicle: Any) -> bool:
        """Whether the left turn signal of a vehicle is lit; those who face oncoming cars have one, which flashes."""
        flashes = FLASHES * vehicle.decisions / self.config.decision_frequency
        return self.scenario.cars > 0 and not self._roads and signals_left(vehicle) and flashes % 1.0 < 0.5

    def _draw_ground(self, reach: float) -> None:
        self._ground = Canvas(self._ground.surface, reach)
        self._ground.surface.fill(GRASS if self.scenario.lanes or self._roads else GROUND)
        if self._roads:
            self._ground.lanes(self._roads)
        elif self.scenario.lanes:
            self._ground.roads()
        else:
            self._ground.grid()
        pygame.transform.smoothscale(self._ground.surface, self._small_ground.get_size(), self._small_ground)
        self._map.blit(self._ground.surface, (0, 0))
