"""Rendering: the format of frames, what they show, and that drawing has no side effects."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pygame
import pytest
from numpy.typing import NDArray

import mo_deepdrive  # noqa: F401  (registers the ids)
from mo_deepdrive.drawing import rendering
from mo_deepdrive.drawing.canvas import ASPHALT, TRAFFIC_PAINT
from mo_deepdrive.drawing.rendering import Panel, Viewer
from mo_deepdrive.simulation.state import ENDS, LENGTH, MAP_SIZE
from mo_deepdrive.world.batch import Draws, WorldBatch
from mo_deepdrive.world.config import EnvConfig, parse

SCENARIOS = ("one_waypoint", "static_obstacle", "intersection", "left_turn")
DRAWN = (*SCENARIOS, "roundabout", "roundabout_solo")
SINGLE_IDS = ("mo-deepdrive-one-waypoint-v0", "mo-deepdrive-static-obstacle-v0", "mo-deepdrive-left-turn-v0")
INTERSECTION_ID = "mo-deepdrive-intersection-v0"
MAP_PIXELS = 720
SPEED_UP = 3
BLUE, ORANGE, YELLOW, RED = (38, 116, 232), (240, 126, 38), (255, 244, 190), (255, 36, 40)


def place(batch: WorldBatch, number: float) -> None:
    """Start an episode for which ``number`` is drawn again and again."""
    draws = Draws(1, batch.scenario.draws)
    draws.blocks[:] = number
    batch.place(draws)


def start(scenario: str) -> tuple[WorldBatch, Viewer]:
    """A world at the start of an episode, and a viewer of it."""
    config = parse(EnvConfig, {"scenario": scenario, "harmful_g_force": None}, "settings")
    batch = WorldBatch(config, 1)
    place(batch, 0.5)
    return batch, Viewer(config, "rgb_array")


def drive(batch: WorldBatch, decisions: int = 1) -> None:
    for _ in range(decisions):
        batch.step(np.full(batch.terminated.shape, SPEED_UP))


def colour_at(frame: NDArray[np.uint8], x: float, y: float) -> NDArray[np.int64]:
    """Mean colour of the 3 x 3 pixels around a point of the world (m)."""
    column, row = round(x / MAP_SIZE * MAP_PIXELS), round((1 - y / MAP_SIZE) * MAP_PIXELS)
    return np.asarray(frame[row - 1 : row + 2, column - 1 : column + 2].mean(axis=(0, 1)), dtype=np.int64)


def resembles(colour: NDArray[np.int64], expected: tuple[int, ...], tolerance: int = 70) -> bool:
    return bool(np.abs(colour - expected).max() < tolerance)


def ahead_of(vehicle: Any, ahead: float, right: float = 0.0) -> tuple[float, float]:
    """The point that is ``ahead`` m in front and ``right`` m to the right of a vehicle's centre."""
    cos, sin = np.cos(vehicle.heading), np.sin(vehicle.heading)
    return vehicle.x - sin * ahead + cos * right, vehicle.y + cos * ahead + sin * right


@pytest.mark.parametrize("scenario", DRAWN)
def test_a_frame_is_a_new_writable_rgb_array_in_a_size_for_video_encoders(scenario: str) -> None:
    batch, viewer = start(scenario)
    first, second = viewer.draw(batch.state[0]), viewer.draw(batch.state[0])
    assert first.dtype == np.uint8
    height, width, channels = first.shape
    assert (height % 16, width % 16, channels) == (0, 0, 3)
    assert first.flags.c_contiguous
    assert first.flags.writeable
    first[:] = 0
    assert second.any()


def test_many_vehicles_are_drawn_on_their_lanes_until_they_have_left() -> None:
    config = parse(EnvConfig, {"scenario": "roundabout", "vehicles": 16}, "settings")
    batch, viewer = WorldBatch(config, 1), Viewer(config, "rgb_array")
    place(batch, 0.5)
    batch.state[0, 0].route_distance = 200.0  # nothing is left of its route
    reach = rendering.reach_of(batch.state[0], config.scenario_data.routes)
    scale, low = MAP_SIZE / (2 * reach), MAP_SIZE / 2 - reach
    shown = [viewer.draw(batch.state[0])]
    batch.state["end"] = ENDS.index("collision")
    shown.append(viewer.draw(batch.state[0]))
    for vehicle, paint in zip(batch.state[0], rendering.VEHICLE_COLOURS, strict=True):
        x, y = ahead_of(vehicle, 1.7)  # the bonnet
        before, after = (colour_at(frame, (x - low) * scale, (y - low) * scale) for frame in shown)
        assert resembles(before, paint)
        assert resembles(after, ASPHALT, 30)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_each_car_shows_in_its_colour_where_it_is(scenario: str) -> None:
    batch, viewer = start(scenario)
    drive(batch, 20)
    frame = viewer.draw(batch.state[0])
    for vehicle, colour in zip(batch.state[0], (BLUE, ORANGE), strict=False):
        assert resembles(colour_at(frame, *ahead_of(vehicle, 1.8)), colour)
        assert not resembles(colour_at(frame, *ahead_of(vehicle, LENGTH)), colour)


def test_the_destination_and_the_bicycle_show_where_they_are() -> None:
    batch, viewer = start("static_obstacle")
    vehicle = batch.state[0, 0]
    frame = viewer.draw(batch.state[0])
    goal_x, goal_y = vehicle.waypoints[0]
    ground = colour_at(frame, goal_x + 6.0, goal_y)
    assert resembles(colour_at(frame, goal_x, goal_y), BLUE)
    assert resembles(colour_at(frame, goal_x + 1.65, goal_y), BLUE)
    assert np.abs(colour_at(frame, *vehicle.obstacle.mean(axis=0)) - ground).max() > 30


def oncoming(acceleration: float = 0.0, y: float = 42.0) -> tuple[WorldBatch, Viewer, Any]:
    batch, viewer = start("left_turn")
    batch.state["cars"]["present"] = False
    car = batch.state[0, 0]["cars"][0]
    car["present"], car["y"], car["acceleration"] = True, y, acceleration
    return batch, viewer, car


def test_an_oncoming_car_shows_where_it_is_while_it_is_there() -> None:
    batch, viewer, car = oncoming()
    roof = car["x"], car["y"] + 0.5
    shown = colour_at(viewer.draw(batch.state[0]), *roof)
    assert resembles(shown, TRAFFIC_PAINT)
    car["present"] = False
    assert not resembles(colour_at(viewer.draw(batch.state[0]), *roof), TRAFFIC_PAINT)
    car["present"], car["y"] = True, 5000.0  # the last of a slow flow is kilometres away
    viewer.draw(batch.state[0])


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_trail_and_the_sums_are_cleared_at_reset(scenario: str) -> None:
    batch, viewer = start(scenario)
    beginning = batch.state.copy()
    fresh = viewer.draw(batch.state[0])
    for _ in range(20):
        drive(batch)
        viewer.draw(batch.state[0])
    batch.state[:] = beginning
    assert np.array_equal(viewer.draw(batch.state[0]), fresh)


@pytest.mark.parametrize("cost_sign", ["maximise", "paper"])
def test_the_panel_shows_the_return_with_the_sign_of_the_rewards(
    cost_sign: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = parse(EnvConfig, {"scenario": "one_waypoint", "cost_sign": cost_sign}, "settings")
    batch = WorldBatch(config, 1)
    place(batch, 0.5)
    viewer = Viewer(config, "rgb_array")
    viewer.draw(batch.state[0])
    returns = np.zeros(len(viewer.objectives))
    written: list[tuple[str, float]] = []
    monkeypatch.setattr(Panel, "_write", lambda _, text, x, *__: written.append((text, x)))
    for _ in range(12):
        drive(batch)
        returns += batch.rewards[0, 0]
        written.clear()
        viewer.draw(batch.state[0])
    assert (returns[viewer.objectives.index("g_force")] < -0.01) == (cost_sign == "maximise")
    _, *totals = [text for text, x in written if x == -316]  # below the time
    decision = [text for text, x in written if x == -226]
    assert list(map(float, totals)) == pytest.approx(returns, abs=0.006)
    assert list(map(float, decision)) == pytest.approx(batch.rewards[0, 0], abs=0.006)
    assert "-0.00" not in [text for text, _ in written]


def test_an_unknown_render_mode_is_an_error_that_names_the_allowed_ones() -> None:
    with pytest.raises(ValueError, match=r"render_mode = .*rgb_array.*human"):
        Viewer(EnvConfig(scenario="one_waypoint"), "ansi")


def test_rgb_array_needs_no_display_and_works_after_pygame_quits(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("rgb_array must not touch the display")

    monkeypatch.setattr(pygame.display, "set_mode", refuse)
    monkeypatch.setattr(pygame.display, "init", refuse)
    batch, viewer = start("intersection")
    before = viewer.draw(batch.state[0])
    pygame.quit()
    assert np.array_equal(viewer.draw(batch.state[0]), before)
    viewer.close()


def test_vector_environments_render_one_frame_per_world() -> None:
    envs = gymnasium.make_vec(INTERSECTION_ID, num_envs=2, render_mode="rgb_array")
    envs.reset(seed=1)
    for _ in range(5):
        envs.step(np.full((2, 2), SPEED_UP))
    frames: Any = envs.render()
    envs.close()
    assert len(frames) == 2
    assert frames[0].shape == frames[1].shape
    assert (frames[0] != frames[1]).any()


@pytest.fixture
def human_env(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """An environment with an invisible window, at a frequency that does not slow down the test."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.quit()
    env = gymnasium.make(SINGLE_IDS[0], render_mode="human", decision_frequency=60, disable_env_checker=True)
    yield env
    env.close()


def test_human_mode_shows_every_step_in_a_window(human_env: Any) -> None:
    human_env.reset(seed=1)
    window = pygame.display.get_surface()
    assert window is not None
    before = pygame.surfarray.array3d(window)
    for _ in range(30):
        human_env.step(SPEED_UP)
    assert human_env.render() is None
    assert (pygame.surfarray.array3d(pygame.display.get_surface()) != before).any()
    human_env.close()
    assert not pygame.display.get_init()


def test_an_episode_continues_after_its_window_is_closed(human_env: Any) -> None:
    human_env.reset(seed=1)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    human_env.step(SPEED_UP)
    assert not pygame.display.get_init()
    human_env.step(SPEED_UP)
    assert not pygame.display.get_init()


def test_human_mode_says_that_there_is_no_window(human_env: Any) -> None:
    with pytest.warns(UserWarning, match=r"shows no window \(SDL has only 'dummy'\)"):
        human_env.reset(seed=1)
