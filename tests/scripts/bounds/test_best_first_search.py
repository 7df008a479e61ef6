"""The best-first search solves scenarios."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from scripts.bounds.best_first_search import solve_scenario

FAR = ((19.5, 46.0), (20.5, 46.0))  # a bicycle at the edge of the map
STRAIGHT_AHEAD = (30.0, 25.5)


@pytest.mark.parametrize(("obstacle", "solved"), [(FAR, True), (((9.8, 25.6), (12.0, 25.6)), False)])
def test_scenarios_are_solved_unless_the_bicycle_is_at_the_nose(
    make_single: Callable[..., Any], obstacle: tuple[tuple[float, float], ...], solved: bool
) -> None:
    """The discrete actions cannot reverse. A solution arrives in the public environment."""
    env = make_single("static_obstacle")
    options = {"obstacle": obstacle, "destination": STRAIGHT_AHEAD}
    env.reset(seed=0, options=options)
    actions = solve_scenario(env.batch.state[0].copy(), 512)
    assert bool(actions) == solved
    env.reset(seed=0, options=options)
    assert [env.step(action)[-1].get("end") for action in actions][-1:] == ["arrived"] * solved
