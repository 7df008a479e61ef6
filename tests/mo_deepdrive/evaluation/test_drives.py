"""Recorded drives against the telemetry of environments that are stepped one by one."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from algorithms.runs.build import load_policy
from algorithms.runs.policy_evaluation import evaluate_front_policies
from algorithms.runs.run_directory import Run
from mo_deepdrive import parallel_env
from mo_deepdrive.evaluation.drives import READINGS, Playback, record_scenes
from mo_deepdrive.evaluation.env_adapter import is_drivable
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.simulation.state import MAP_CENTRE, MAP_SIZE

ONE_WAYPOINT = "mo-deepdrive-one-waypoint-v0"
LEFT_TURN = "mo-deepdrive-left-turn-v0"


class Scripted:
    """The same actions (T, V) whatever is observed."""

    def __init__(self, actions: np.ndarray):
        self.actions = actions
        self.decision = 0

    def __call__(self, observations: np.ndarray, accrued: np.ndarray, discounts: np.ndarray) -> np.ndarray:
        self.decision += 1
        return self.actions[self.decision - 1][None]


def telemetry(env_id: str, seed: int, plan: np.ndarray, idle: Any, **arguments: Any) -> list[dict[str, float]]:
    """Telemetry before the first and after every decision of one episode."""
    env: Any = gymnasium.make(env_id, disable_env_checker=True, **arguments).unwrapped
    env.reset(seed=seed)
    readings, over = [env.telemetry()[0]], False
    while not over:
        now = len(readings) - 1
        _, _, terminated, truncated, _ = env.step(plan[now] if now < len(plan) else idle)
        readings.append(env.telemetry()[0])
        over = terminated or truncated
    return readings


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_a_drive_is_what_telemetry_reports(action_type: str) -> None:
    rng = np.random.default_rng(5)
    shape, idle = ((12,), np.array(0)) if action_type == "discrete" else ((12, 3), np.array([0.0, 0.0, -1.0]))
    plans = [rng.integers(0, 22, shape) if len(shape) == 1 else rng.uniform(-1, 1, shape) for _ in range(3)]
    arguments = {"action_type": action_type, "time_limit": 4}
    seeds = [11, 12]
    driver = Playback(plans * 2, action_type)
    scenes = record_scenes(driver, ONE_WAYPOINT, arguments, seeds=seeds, drives=3)
    assert [scene.seed for scene in scenes] == seeds
    for scene in scenes:
        assert scene.decision_frequency == 10
        assert not scene.lanes
        for plan, drive in zip(plans, scene.drives, strict=True):
            expected = telemetry(ONE_WAYPOINT, scene.seed, plan, idle, **arguments)
            assert drive.readings[:, 0].tolist() == [[now[name] for name in READINGS] for now in expected]
            assert drive.cars.shape == (len(expected), 0, 3)
            assert drive.ends[0] in ("time_limit", "arrived", "harmful_g_force", "circling", "backwards")
    assert scenes[0].routes[0].tolist() != scenes[1].routes[0].tolist()


def test_a_drive_of_many_vehicles_is_what_telemetry_reports_until_each_has_ended() -> None:
    arguments = {"vehicles": 8, "cars": 2, "time_limit": 5, "harmful_g_force": 0.4}
    driver = Scripted(np.random.default_rng(2).integers(0, 22, (60, 8)))
    (scene,) = record_scenes(driver, "mo-deepdrive-roundabout-v0", arguments, seeds=[3], drives=1)
    env = parallel_env(scenario="roundabout", **arguments)
    env.reset(seed=3)
    expected = [env.telemetry()]
    ends: dict[str, tuple[int, str]] = {}
    while env.agents:
        actions = driver.actions[len(expected) - 1]
        infos = env.step({agent: int(actions[int(agent[8:])]) for agent in env.agents})[-1]
        expected.append(env.telemetry())
        ends |= {agent: (len(expected) - 1, info["end"]) for agent, info in infos.items() if info}
    (drive,) = scene.drives
    assert drive.ends == tuple(ends[f"vehicle_{v}"][1] for v in range(8))
    assert len({last for last, _ in ends.values()}) > 1
    assert (len(scene.roads), len(scene.routes), scene.roads[0].give_way.shape) == (12, 8, (2, 2))
    for v in range(8):
        last, _ = ends[f"vehicle_{v}"]
        readings = [[now[v][name] for name in READINGS] for now in expected[: last + 1]]
        assert drive.readings[: last + 1, v].tolist() == readings
        assert np.isnan(drive.readings[last + 1 :, v]).all()
    assert drive.cars[:, 1, 0].tolist() == [now[0]["car_2_x"] for now in expected]


def test_a_drive_at_the_left_turn_has_the_oncoming_cars() -> None:
    plan = np.array([14] * 10)
    arguments = {"time_limit": 8}
    (scene,) = record_scenes(Playback([plan], "discrete"), LEFT_TURN, arguments, seeds=[3], drives=1)
    (drive,) = scene.drives
    assert scene.lanes
    assert len(scene.routes[0]) == 3
    expected = telemetry(LEFT_TURN, 3, plan, np.array(0), **arguments)
    assert len(drive.cars) == len(expected)
    present = 0
    for now, cars in zip(expected, drive.cars, strict=True):
        for number, position in enumerate(cars, 1):
            if now[f"car_{number}_present"]:
                present += 1
                assert position.tolist() == [now[f"car_{number}_x"], now[f"car_{number}_y"], np.pi]
            else:
                assert np.isnan(position).all()
    assert present > 0
    left, bottom, side = scene.box(5.0)
    assert max(left, bottom) <= MAP_CENTRE - MAP_SIZE / 2 + 1e-9
    assert min(left, bottom) + side >= MAP_CENTRE + MAP_SIZE / 2 - 1e-9


def test_bicycles_are_in_the_scene_and_in_the_box() -> None:
    driver = Playback([np.array([], dtype=np.int64)], "discrete")
    arguments = {"time_limit": 1}
    (scene,) = record_scenes(driver, "mo-deepdrive-static-obstacle-v0", arguments, seeds=[2], drives=1)
    assert scene.obstacles.shape == (1, 2, 2)
    left, bottom, side = scene.box(5.0)
    for x, y in [*scene.routes[0], *scene.obstacles[0], *scene.drives[0].readings[:, 0, :2]]:
        assert left + 5 - 1e-9 <= x <= left + side - 5 + 1e-9
        assert bottom + 5 - 1e-9 <= y <= bottom + side - 5 + 1e-9


@pytest.mark.slow
def test_the_drives_of_policies_earn_what_their_evaluation_measured() -> None:
    run = Run.open("one_waypoint_front-pcn-printed")
    agent, front = load_policy(run), Front.read(run.path)
    seed = 2_000_000
    policy = agent.policies(front.conditions.astype(np.float32))
    arguments = run.experiment.environment.arguments
    (scene,) = record_scenes(policy, ONE_WAYPOINT, arguments, seeds=[seed], drives=len(front))
    evaluations = evaluate_front_policies(agent, front, run.experiment, episodes=1, seed=seed)
    for drive, evaluation in zip(scene.drives, evaluations, strict=True):
        assert len(drive.readings) == evaluation.lengths[0, 0] + 1
        assert drive.ends == (evaluation.ends[0, 0],)
        for name in ("g_force", "jerk"):
            total = -drive.readings[1:, 0, READINGS.index(name)].sum()
            assert total == pytest.approx(evaluation.returns[0, 0, front.objectives.index(name)], rel=1e-5)


def test_only_scenarios_of_this_package_are_drivable() -> None:
    assert is_drivable(ONE_WAYPOINT)
    assert is_drivable(f"mo_deepdrive:{LEFT_TURN}")
    assert is_drivable("mo-deepdrive-intersection-v0")
    assert not is_drivable("deep-sea-treasure-v0")
    with pytest.raises(ValueError, match="'CartPole-v1' cannot be recorded"):
        record_scenes(lambda *_: 0, "CartPole-v1", {}, seeds=[0], drives=1)
