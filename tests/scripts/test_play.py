"""Driving by hand: keys as actions, people in a world, and the script with a window that nobody sees."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import imageio.v3 as iio
import numpy as np
import pygame
import pytest
import torch
from numpy.typing import NDArray

from algorithms.actor_critic import ActorCritic
from algorithms.common.accrued_reward import AccruedReward
from algorithms.driving import HOLD, PICTURES, HumanPlayEnv, Keys, Outcome, choose_action
from algorithms.experiments.config import make_experiment
from algorithms.experiments.run_directory import Run
from algorithms.experiments.training import build
from algorithms.reporting.videos import make_render_env
from mo_deepdrive.actions import DISCRETE, MICRO_STEER, action_names
from mo_deepdrive.simulation.state import VEHICLE

ONE, TWO = "mo-deepdrive-one-waypoint-v0", "mo-deepdrive-intersection-v0"
NOTHING, UP, DOWN = Keys(False, False, False, False), Keys(True, False, False, False), Keys(False, True, False, False)
LEFT, RIGHT = Keys(False, False, True, False), Keys(False, False, False, True)
UP_LEFT = Keys(True, False, True, False)


# ------------------------------------------------------------------------------------------------------ keys as actions


def chosen(keys: Keys, action_type: str = "discrete", **fields: float) -> str:
    """The name of the action for a vehicle whose state is zero but for ``fields``."""
    vehicle = np.zeros(1, dtype=VEHICLE)[0]
    for name, value in fields.items():
        vehicle[name] = value
    return action_names(action_type)[choose_action(keys, vehicle, action_type)]


@pytest.mark.parametrize("action_type", list(DISCRETE))
def test_keys_choose_actions_by_what_they_do(action_type: str) -> None:
    assert chosen(NOTHING, action_type, speed=5.0, steer=0.1) == "idle"
    assert chosen(UP, action_type) == "decay steer, increase speed"
    assert chosen(DOWN, action_type, speed=3.0) == "decay steer, decrease speed"
    assert chosen(UP_LEFT, action_type) == "large steer left, increase speed"
    assert chosen(Keys(False, True, False, True), action_type) == "large steer right, decrease speed"


def test_the_wheel_turns_as_far_as_it_can_at_every_speed() -> None:
    assert chosen(LEFT, speed=1.0) == "large steer left, maintain speed"
    assert chosen(LEFT, speed=8.0, steer=0.1) == "small steer left, maintain speed"
    assert chosen(RIGHT, speed=8.0, steer=-0.1) == "small steer right, maintain speed"


def test_the_wheel_goes_straight_when_nobody_turns_it() -> None:
    assert chosen(UP, speed=3.0, steer=0.1).startswith("micro steer")
    assert chosen(UP, speed=3.0, steer=MICRO_STEER) == "decay steer, increase speed"
    assert chosen(UP, "discrete-16", speed=3.0, steer=0.01) == "decay steer, increase speed"


def test_a_foot_off_the_pedal_lets_the_car_roll() -> None:
    assert chosen(LEFT, speed=2.0, throttle=1.0) == "large steer left, decrease speed"
    assert chosen(LEFT, speed=2.0, throttle=0.0) == "large steer left, maintain speed"


def test_both_keys_of_a_pair_brake_and_go_straight() -> None:
    assert chosen(Keys(True, True, False, False)) == "decay steer, decrease speed"
    assert chosen(Keys(True, False, True, True)) == "decay steer, increase speed"


# --------------------------------------------------------------------------------------------------- the environment


def make_human_env(
    env_id: str = ONE, *, seats: tuple[int, ...] = (0,), film: Any = None, **arguments: Any
) -> HumanPlayEnv:
    world = make_render_env(env_id, arguments)
    human_env = HumanPlayEnv(world.unwrapped, seats, film=film)
    human_env.reset(seed=1)
    return human_env


def pressed(*keys: Keys, again: bool = False) -> NDArray[np.int8]:
    """The action that says what everybody holds down."""
    return np.array([*(key for each in keys for key in each), again], dtype=np.int8)


def hold(human_env: HumanPlayEnv, *keys: Keys, decisions: int = 1) -> list[dict[str, Any]]:
    """Hold keys for some decisions; the infos of all steps."""
    return [human_env.step(pressed(*keys))[4] for _ in range(decisions * PICTURES)]


def vehicles(human_env: HumanPlayEnv) -> Any:
    return human_env.world.batch.state[0]


@pytest.mark.parametrize("action_type", ["discrete", "discrete-16", "continuous"])
def test_the_keys_drive_a_car(action_type: str) -> None:
    human_env = make_human_env(action_type=action_type)
    (car,) = vehicles(human_env)
    start = car.copy()
    hold(human_env, UP, decisions=20)
    assert 1.5 < car.speed < 2.5
    assert car.x > start.x + 1.0
    assert car.heading == pytest.approx(start.heading, abs=1e-6)
    hold(human_env, LEFT, decisions=5)
    assert car.heading > start.heading + 0.1
    heading = car.heading
    hold(human_env, RIGHT, decisions=10)
    assert car.heading < heading - 0.1
    speed = car.speed
    hold(human_env, NOTHING, decisions=5)
    assert 0.9 * speed < car.speed < speed
    hold(human_env, DOWN, decisions=10)
    assert car.speed < 0.2


def test_continuous_actions_drive_as_the_discrete_ones_do() -> None:
    discrete, continuous = make_human_env(), make_human_env(action_type="continuous")
    for keys in (UP, UP_LEFT, LEFT, NOTHING, RIGHT, DOWN):
        for human_env in (discrete, continuous):
            hold(human_env, keys, decisions=6)
        for field in ("x", "y", "heading", "speed"):
            assert vehicles(continuous)[0][field] == pytest.approx(vehicles(discrete)[0][field], abs=1e-4), field


def test_a_key_pressed_for_one_picture_counts_for_a_whole_decision() -> None:
    short, long = make_human_env(), make_human_env()
    for picture in range(PICTURES):
        short.step(pressed(UP if picture == 1 else NOTHING))
    hold(long, UP)
    assert vehicles(short)[0].throttle == vehicles(long)[0].throttle > 0.0
    hold(short, NOTHING)
    assert vehicles(short)[0].throttle == 0.0


def test_two_people_drive_a_car_each() -> None:
    human_env = make_human_env(TWO, seats=(0, 1))
    hold(human_env, UP, NOTHING, decisions=10)
    first, second = vehicles(human_env)
    assert (first.speed > 0.5, second.speed) == (True, 0.0)
    hold(human_env, NOTHING, UP, decisions=10)
    assert second.speed > 0.5
    assert first.throttle == 0.0


def test_every_vehicle_needs_somebody() -> None:
    with pytest.raises(ValueError, match=r"seats = \[1\] .* 2 vehicles .* agent"):
        make_human_env(TWO, seats=(1,))


def test_an_outcome_says_how_everybody_ended_and_what_they_earned() -> None:
    human_env = make_human_env(TWO, seats=(0, 1), time_limit=2, end_together=False)
    total = np.zeros((2, human_env.world.reward_dim))
    for _ in range(20 * PICTURES):
        _, rewards, terminated, truncated, info = human_env.step(pressed(UP, NOTHING))
        total += rewards
        assert not terminated
        assert not truncated
    outcome: Outcome = info["outcome"]
    assert (outcome.episode, outcome.seed) == (1, 1)
    assert outcome.ends == ("time_limit", "time_limit")
    assert outcome.seconds == (2.0, 2.0)
    np.testing.assert_allclose(outcome.returns, total)
    distances = outcome.returns[:, human_env.world.objectives.index("distance")]
    assert distances[0] > 1.0
    assert distances[1] == 0.0


def test_the_end_stands_for_a_moment_and_the_next_episode_is_another_one() -> None:
    human_env = make_human_env(time_limit=0.5)
    first = vehicles(human_env)[0].waypoints.copy()
    hold(human_env, UP, decisions=5)
    where = vehicles(human_env)[0].x
    for still in range(1, round(HOLD * 10) * PICTURES + 1):
        terminated = human_env.step(pressed(UP))[2]
        assert terminated == (still == round(HOLD * 10) * PICTURES)
    assert vehicles(human_env)[0].x == where
    human_env.reset()
    assert (vehicles(human_env)[0].waypoints != first).any()
    infos = hold(human_env, NOTHING, decisions=5)
    assert (infos[-1]["outcome"].episode, infos[-1]["outcome"].seed) == (2, 2)


def test_starting_again_brings_the_same_scenario_back() -> None:
    human_env = make_human_env()
    beginning = vehicles(human_env).copy()
    hold(human_env, UP_LEFT, decisions=5)
    *_, terminated, truncated, info = human_env.step(pressed(NOTHING, again=True))
    assert (terminated, truncated, info) == (False, True, {})
    human_env.reset()
    assert vehicles(human_env).tobytes() == beginning.tobytes()


def test_without_a_seed_the_scenarios_differ_and_can_still_be_driven_again() -> None:
    first, second = make_human_env(), make_human_env()
    starts = []
    for human_env in (first, second):
        fresh = HumanPlayEnv(human_env.world, (0,))
        fresh.reset()
        starts.append(vehicles(fresh).copy())
        fresh.reset()
        assert vehicles(fresh).tobytes() == starts[-1].tobytes()
    assert starts[0].tobytes() != starts[1].tobytes()


def test_a_film_gets_a_picture_per_decision_from_the_start_to_the_end() -> None:
    film: list[NDArray[np.uint8]] = []
    human_env = make_human_env(time_limit=0.3, film=film.append)
    start = human_env.render()
    hold(human_env, UP, decisions=3 + round(HOLD * 10))
    assert len(film) == 3 + round(HOLD * 10)
    assert np.array_equal(film[0], start)
    assert (film[3] != film[2]).any()
    assert np.array_equal(film[-1], film[3])


# ------------------------------------------------------------------------------------------------------- a trained run


def make_run(path: Path, env_id: str = TWO, utility: str = "intersection_linear", **arguments: Any) -> Path:
    """A run that has learnt for a few updates."""
    experiment = make_experiment(
        {
            "environment": {"id": env_id, "arguments": arguments},
            "utility": {"name": utility},
            "algorithm": {"name": "mo_a2c", "steps": 8, "hidden": [8], "learning_rate": 0.01},
            "training": {"total_timesteps": 128, "num_envs": 4},
        }
    )
    run = Run.create(experiment, path)
    agent = build(experiment)
    agent.train(experiment.training.total_timesteps)
    agent.save(run.checkpoint)
    run.unlock()
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "run", time_limit=3)


def opened(path: Path) -> ActorCritic:
    run = Run.open(path)
    agent = build(run.experiment, num_envs=1)
    agent.load(run.checkpoint, policy_only=True)
    return agent


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
@pytest.mark.parametrize("mine", [0, 1])
def test_the_agent_drives_the_other_vehicle_as_it_would_drive_it_anywhere(
    run: Path, tmp_path: Path, mine: int, action_type: str
) -> None:
    path = run if action_type == "discrete" else make_run(tmp_path / "run", action_type=action_type, time_limit=3)
    agent = opened(path)
    world: Any = make_human_env(TWO, seats=(0, 1), time_limit=3, action_type=action_type).world
    human_env = HumanPlayEnv(world, (mine,), agent=agent, generator=torch.Generator().manual_seed(5))
    human_env.reset(seed=1)
    hold(human_env, NOTHING, decisions=20)
    driven = vehicles(human_env).copy()

    generator = torch.Generator().manual_seed(5)
    observations, _ = world.reset(seed=1)
    accrued_reward = AccruedReward.begin(1, 2, world.reward_dim)
    rest = 0 if action_type == "discrete" else (0.0, 0.0, -1.0)
    for _ in range(20):
        actions = agent.env.environment_actions(agent.act(observations, accrued_reward, generator))
        actions[0, mine] = rest
        observations, rewards, *_ = world.step(actions)
        accrued_reward.add(rewards, agent.gamma)
    assert driven.tobytes() == vehicles(human_env).tobytes()
    assert driven[1 - mine].travelled > 0.0


# ----------------------------------------------------------------------------------------------------------- the script

Typist = Callable[[dict[int, list[tuple[int, int]]]], None]
PRESS, RELEASE = pygame.KEYDOWN, pygame.KEYUP


@pytest.fixture(scope="module")
def play(repository: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("play", repository / "scripts" / "play.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def typing(monkeypatch: pytest.MonkeyPatch) -> Iterator[Typist]:
    """Press and release keys when so many pictures have been shown, in a window that nobody sees."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")

    def type_keys(schedule: dict[int, list[tuple[int, int]]]) -> None:
        shown = 0

        def flip() -> None:
            nonlocal shown
            for kind, key in schedule.get(shown, ()):
                pygame.event.post(pygame.event.Event(kind, key=key) if key else pygame.event.Event(kind))
            shown += 1
            assert shown <= max(schedule) + 5, "the window should have closed by now"

        monkeypatch.setattr(pygame.display, "flip", flip)

    yield type_keys
    pygame.display.quit()


def test_a_drive_in_the_window_ends_the_way_it_was_driven(
    play: ModuleType, typing: Typist, capsys: pytest.CaptureFixture[str]
) -> None:
    typing({0: [(PRESS, pygame.K_UP)], 60 * PICTURES: [(PRESS, pygame.K_ESCAPE)]})
    assert play.main(["--env", ONE, "--seed", "3", "--fps", "1000"]) == 0
    controls, title, names, units, _, row = [
        line.rstrip() for line in capsys.readouterr().out.splitlines() if line.strip()
    ]
    assert controls == "vehicle 0: arrow keys; R starts again, Escape quits"
    assert title == "episode 1, seed 3"
    assert names.split() == ["end", "time", "distance", "destination", "g_force", "jerk"]
    assert units.split() == ["s", "m", "g", "m/s^3"]
    vehicle, end, seconds, *returns = row.split()
    assert (vehicle, end, float(seconds)) == ("vehicle_0", "backwards", 5.1)
    assert [float(value) < 0.0 for value in returns] == [True, False, True, True]
    assert not pygame.display.get_init()


def test_two_people_drive_at_one_keyboard(
    play: ModuleType, typing: Typist, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    environments: list[HumanPlayEnv] = []
    monkeypatch.setattr(
        play, "HumanPlayEnv", lambda *args, **kw: environments.append(HumanPlayEnv(*args, **kw)) or environments[0]
    )
    typing({0: [(PRESS, pygame.K_UP), (PRESS, pygame.K_w), (PRESS, pygame.K_a)], 12 * PICTURES: [(pygame.QUIT, 0)]})
    assert play.main(["--env", TWO, "--seed", "2", "--fps", "1000"]) == 0
    first, second = vehicles(environments[0])
    assert first.speed > 0.8
    assert second.speed > 0.8
    assert first.heading == pytest.approx(first.start_heading, abs=1e-6)
    assert second.heading > second.start_heading + 0.1
    said = capsys.readouterr().out
    assert said.startswith("vehicle 0: arrow keys; vehicle 1: W A S D; R starts again")
    assert "episode" not in said


def test_a_drive_against_a_run_is_recorded(
    play: ModuleType, typing: Typist, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    decisions = 30 + 5
    typing({decisions * PICTURES: [(PRESS, pygame.K_ESCAPE)]})
    options = ["--against", str(run), "--vehicle", "1", "--stochastic", "--record", str(tmp_path / "drive.mp4")]
    assert play.main(["--env", TWO, "--fps", "1000", *options]) == 0
    rows = [line.split()[:3] for line in capsys.readouterr().out.splitlines() if "vehicle_" in line]
    assert rows == [["vehicle_0", "time_limit", "3.0"], ["vehicle_1", "time_limit", "3.0"]]
    assert len(iio.imread(tmp_path / "drive.mp4")) == decisions


def test_what_cannot_be_played_is_refused(
    play: ModuleType,
    run: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    single = make_run(tmp_path / "single", ONE, "one_waypoint_linear", time_limit=1)
    untrained = tmp_path / "untrained"
    untrained.mkdir()
    (untrained / "config.yaml").write_bytes((run / "config.yaml").read_bytes())

    def refused(*options: str) -> str:
        assert play.main([*options]) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith("error: ")
        return said.err

    assert "did you mean 'mo-deepdrive-intersection-v0'" in refused("--env", "mo-deepdrive-intersction-v0")
    assert "only this package's environments" in refused("--env", "minecart-v0")
    assert "not a run directory" in refused("--env", TWO, "--against", str(tmp_path))
    assert f"drives in {TWO}, not in {ONE}" in refused("--env", ONE, "--against", str(run))
    assert "no other vehicle" in refused("--env", ONE, "--against", str(single))
    assert "checkpoint.safetensors" in refused("--env", TWO, "--against", str(untrained))
    assert "--against RUN" in refused("--env", TWO, "--vehicle", "1")
    assert "--against RUN" in refused("--env", TWO, "--stochastic")
    assert "--seed -1" in refused("--env", TWO, "--seed", "-1")
    assert "--fps 0" in refused("--env", TWO, "--fps", "0")
    assert "nowhere" in refused("--env", TWO, "--record", str(tmp_path / "nowhere" / "drive.mp4"))


def no_window(play: ModuleType, capsys: pytest.CaptureFixture[str]) -> str:
    """The error of a drive that needs a window where there can be none."""
    assert play.main(["--env", ONE]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: no window can be opened")
    assert "DISPLAY" in error
    return error


def test_without_a_display_it_says_what_is_missing(
    play: ModuleType, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonesuch")
    assert "nonesuch" in no_window(play, capsys)


def test_a_window_that_nobody_could_see_is_refused_unless_it_is_asked_for(
    play: ModuleType, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    for name, result in (("init", None), ("set_caption", None), ("get_driver", "offscreen")):
        monkeypatch.setattr(pygame.display, name, lambda *_, result=result: result)
    assert "'offscreen'" in no_window(play, capsys)
