"""Which scenarios of StaticObstacle are solved, and that solutions are checked in the public environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from algorithms.planning.solvability import describe_geometry, replay, solve_scenario

if TYPE_CHECKING:
    from collections.abc import Callable

FAR = ((19.5, 46.0), (20.5, 46.0))  # a bicycle at the edge of the map
STRAIGHT_AHEAD = (30.0, 25.5)
AT_THE_NOSE = ((9.8, 25.6), (12.0, 25.6))  # a bicycle that points at the nose, 5 cm ahead of it


def test_a_scenario_with_a_far_bicycle_is_solved(make_single: Callable[..., Any]) -> None:
    env = make_single("static_obstacle")
    env.reset(seed=0, options={"obstacle": FAR, "destination": STRAIGHT_AHEAD})
    outcome = solve_scenario(env.batch.state[0].copy(), 512)
    assert outcome.solved
    assert 0 < len(outcome.actions) <= 100


def test_a_scenario_with_a_bicycle_at_the_nose_is_not_solved(make_single: Callable[..., Any]) -> None:
    """The discrete actions cannot reverse; the search reports that it has expanded every node."""
    env = make_single("static_obstacle")
    env.reset(seed=0, options={"obstacle": AT_THE_NOSE, "destination": STRAIGHT_AHEAD})
    outcome = solve_scenario(env.batch.state[0].copy(), 512)
    assert outcome.actions == ""
    assert not outcome.solved
    assert outcome.exhausted
    gap, nearer_end, *_ = describe_geometry(outcome.start)
    assert (gap, nearer_end) == ("0.05", "0.05, 0.04")


def test_a_solution_that_does_not_arrive_is_refused(make_single: Callable[..., Any]) -> None:
    with pytest.raises(RuntimeError, match="seed 7 ends with None"):
        replay(make_single("static_obstacle"), 7, "aaa")
