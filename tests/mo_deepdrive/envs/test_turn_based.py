"""The intersection as one Gymnasium environment: whose turn it is, what a turn returns, and how it ends.

``test_single.py`` tests what all environments have in common, ``test_interfaces.py`` compares the interfaces.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.helpers.interfaces import ACTION_TYPES, PLANS, record

Turn = tuple[np.ndarray, np.ndarray, bool, bool, dict[str, Any]]


def play(make_single: Callable[..., Any], plan: str, action_type: str) -> Any:
    """All turns of a recorded episode, and its joint actions."""
    recording = record(action_type, False)
    number = list(PLANS).index(plan)
    env = make_single("intersection", **recording.arguments)
    turns: list[Turn] = []
    for reset, joint in recording.resets()[: number + 1]:  # an episode continues the random stream of those before it
        turns, chosen = [], [0, 0]
        info = env.reset(**reset)[1]
        while not turns or not (turns[-1][2] or turns[-1][3]):
            vehicle = info["vehicle"]
            turns.append(env.step(joint[min(chosen[vehicle], len(joint) - 1)][vehicle]))
            chosen[vehicle] += 1
            info = turns[-1][4]
    return turns, recording.actions[number]


# ------------------------------------------------------------------------------------------------------------- turns


def test_the_world_moves_after_both_choices_so_neither_sees_the_others(make_single: Any) -> None:
    observations, telemetry = [], []
    for choice in (0, 3, 6):
        env = make_single("intersection")
        env.reset(seed=0)
        before = env.telemetry()
        observation, reward, *_ = env.step(choice)
        observations.append(observation.tobytes())
        assert env.telemetry() == before, "one has chosen, and nothing moves"
        assert not reward.any(), "no reward on its first turn"
        env.step(3)
        assert env.telemetry() != before
        telemetry.append(env.telemetry())
    assert len(set(observations)) == 1
    assert len({car[0]["speed"] for car in telemetry}) == 2, "idle, or one of two ways to accelerate"
    assert len({car[1]["speed"] for car in telemetry}) == 1


# --------------------------------------------------------------------------------------------------------------- ends


@pytest.mark.parametrize("action_type", ACTION_TYPES)
@pytest.mark.parametrize(
    ("plan", "first", "last"),
    [("both arrive", 1, 0), ("the straight one fails", 1, 0), ("the left turn fails", 0, 1)],
)
def test_the_vehicle_that_ends_first_has_one_last_turn_then_only_the_other(
    make_single: Any, plan: str, first: int, last: int, action_type: str
) -> None:
    turns, _ = play(make_single, plan, action_type)
    ended = [(k, info) for k, (*_, info) in enumerate(turns) if "end" in info]
    assert [info["vehicle"] for _, info in ended] == [first, last]
    for _, info in ended:
        end = PLANS[plan].ends[info["vehicle"]]
        assert info == {"vehicle": info["vehicle"], "end": end, "success": end == "arrived"}
    assert {info["vehicle"] for *_, info in turns[ended[0][0] + 1 :]} == {last}
    assert ended[1][0] == len(turns) - 1
    assert not any(terminated or truncated for _, _, terminated, truncated, _ in turns[:-1])
    assert turns[-1][2:4] == (True, False)


def test_the_action_of_a_last_turn_is_ignored_but_must_be_valid(make_single: Any) -> None:
    recording = record("discrete", False)
    actions = recording.actions[0]
    env = make_single("intersection", **recording.arguments)
    info = env.reset(**recording.resets()[0][0])[1]
    chosen = [0, 0]
    while "end" not in info:
        vehicle = info["vehicle"]
        info = env.step(actions[chosen[vehicle]][vehicle])[4]
        chosen[vehicle] += 1
    assert info["vehicle"] == 1
    with pytest.raises(ValueError, match="vehicle 1"):
        env.step(22)
    results = [copy.deepcopy(env).step(answer) for answer in range(22)]
    assert {observation.tobytes() for observation, *_ in results} == {results[0][0].tobytes()}
    assert {reward.tobytes() for _, reward, *_ in results} == {results[0][1].tobytes()}
    assert results[0][4] == {"vehicle": 0}
