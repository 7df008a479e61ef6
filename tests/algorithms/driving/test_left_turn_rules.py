"""The fixed rules for LeftTurn: they find their way, wait for their gap, and see no more than an agent."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

import mo_deepdrive  # noqa: F401  (registers the ids)
from algorithms.driving.left_turn_rules import COLUMN, GapDriver, GapRule, free_time, locate
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.evaluation import Evaluation
from mo_deepdrive.simulation.state import LANE_WIDTH, LENGTH

LEFT_TURN = "mo-deepdrive-left-turn-v0"
TIME = 6  # column of the rewards


def drive(gap: float, actions: str = "discrete", episodes: int = 100, **options: Any) -> Evaluation:
    arguments = {"action_type": actions, **options}
    return evaluate(GapDriver(GapRule(gap=gap), actions), LEFT_TURN, episodes=episodes, env_kwargs=arguments)


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
@pytest.mark.parametrize("gap", [0.0, 5.0])
def test_every_rule_arrives_where_there_is_no_traffic(gap: float, actions: str) -> None:
    evaluation = drive(gap, actions, traffic="none")
    assert evaluation.end_rates()["arrived"] == 1.0
    returns = dict(zip(evaluation.objectives, evaluation.returns[:, 0].mean(axis=0), strict=True))
    assert returns["lane_violation"] > -6.0
    assert returns["g_force"] > -16.0


@pytest.mark.slow
@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_a_rule_that_waits_is_slower_and_safer(actions: str) -> None:
    evaluations = [drive(gap, actions) for gap in (0.0, 2.0, 6.0)]
    collisions = [evaluation.end_rates()["collision"] for evaluation in evaluations]
    assert collisions[0] > collisions[1] > collisions[2]
    assert collisions[0] > 0.2
    assert collisions[2] < 0.02
    times = [-evaluation.returns[evaluation.succeeded[:, 0], 0, TIME].mean() for evaluation in evaluations]
    assert times[0] < times[1] < times[2]


def test_a_rule_waits_before_the_crossing_until_the_gap_is_large_enough() -> None:
    env = gymnasium.make(LEFT_TURN).unwrapped
    driver = GapDriver(GapRule(gap=5.0))
    # Three cars, 3 s apart, and then nobody.
    pinned = {"cars": 3, "desired_speeds": [9.0] * 3, "headways": [4.0, 3.0, 3.0]}
    observation, _ = env.reset(seed=0, options=pinned)
    accrued, ended, stood = np.zeros((1, 7)), False, False
    while not ended:
        seen = observation[None].astype(np.float64)
        front, _ = locate(seen)
        if free_time(seen, np.full(1, 3.0))[0] < 5.0:  # but for a car that is leaving
            assert front[0, 1] < 22.6
            stood = stood or observation[COLUMN["speed"]] < 0.1
        action = driver(observation[None], accrued, np.ones(1))[0]
        observation, reward, terminated, truncated, info = env.step(action)
        accrued += reward
        ended = terminated or truncated
    assert stood
    assert info["end"] == "arrived"


def test_the_place_and_the_heading_follow_from_the_observation() -> None:
    env = gymnasium.make(LEFT_TURN, traffic="none").unwrapped
    driver = GapDriver(GapRule(gap=0.0))
    observation, _ = env.reset(seed=3)
    accrued, ended = np.zeros((1, 7)), False
    while not ended:
        vehicle = env.batch.state[0, 0]  # type: ignore[attr-defined]
        front, heading = locate(observation[None].astype(np.float64))
        # In the crossing, after the second waypoint, the lane lines are not seen.
        if not (vehicle["crossing"] and vehicle["next_waypoint"] == 2):
            assert heading[0] == pytest.approx(vehicle["heading"], abs=0.02)
            np.testing.assert_allclose(front[0], [vehicle["front_x"], vehicle["front_y"]], atol=0.06)
        observation, reward, terminated, truncated, _ = env.step(driver(observation[None], accrued, np.ones(1))[0])
        accrued += reward
        ended = terminated or truncated


def seen(*cars: tuple[float, float]) -> NDArray[np.float64]:
    """An observation (1, size) of oncoming cars: distance and speed of each."""
    row = np.zeros((1, len(COLUMN)))
    row[0, COLUMN["oncoming_1_distance"]] = row[0, COLUMN["oncoming_2_distance"]] = 100.0
    for number, (distance, speed) in enumerate(cars, 1):
        row[0, COLUMN[f"oncoming_{number}_distance"]], row[0, COLUMN[f"oncoming_{number}_speed"]] = distance, speed
    return row


@pytest.mark.parametrize(
    ("cars", "lead_time", "time"),
    [
        ((), 0.0, np.inf),
        (((30.0, 10.0),), 0.0, 3.0),
        (((30.0, 10.0), (60.0, 10.0)), 0.0, 3.0),
        (((-3.0, 10.0), (60.0, 10.0)), 0.0, 0.0),  # the first is in the crossing
        (((-(2 * LANE_WIDTH + LENGTH) + 5.0, 10.0), (60.0, 10.0)), 1.0, 6.0),  # and leaves it in half a second
        (((20.0, 0.0),), 0.0, np.inf),  # it stands
    ],
)
def test_the_free_time_is_that_of_the_next_car_that_has_not_left_before(
    cars: tuple[tuple[float, float], ...], lead_time: float, time: float
) -> None:
    assert free_time(seen(*cars), np.array([lead_time]))[0] == pytest.approx(time)


def test_a_driver_can_be_used_again_and_for_another_number_of_episodes() -> None:
    driver = GapDriver(GapRule(gap=3.0))
    first = evaluate(driver, LEFT_TURN, episodes=40)
    evaluate(driver, LEFT_TURN, episodes=7)
    again = evaluate(driver, LEFT_TURN, episodes=40)
    np.testing.assert_array_equal(first.returns, again.returns)


@pytest.mark.parametrize(("name", "value"), [("gap", -1.0), ("turn_speed", 0.0), ("approach_speed", np.nan)])
def test_numbers_that_make_no_rule_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{name} = {value} of a rule must be a finite number of at least"):
        GapRule(**{"gap": 3.0, name: value})
