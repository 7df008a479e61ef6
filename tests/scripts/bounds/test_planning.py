"""The search for planned drives: what it finds can be replayed and is worth what the environment says."""

from __future__ import annotations

import numpy as np
import pytest

from mo_deepdrive import suite
from mo_deepdrive.evaluation.drives import Playback
from scripts.bounds.planning import ScenarioPlanner, plan_preferences, plan_utility

SEED = 2_000_000


@pytest.mark.slow
@pytest.mark.parametrize("task_id", ["K1", "K3", "K4"])
def test_planned_drives_are_worth_what_the_environment_says(task_id: str) -> None:
    task = suite.load().task(task_id)
    planner = ScenarioPlanner(task, generations=2, population=128)
    utility = task.make_utility()
    planned = planner.plan(planner.start(SEED), lambda returns: np.asarray(utility(returns))[:, None], seed=SEED)
    (drives,) = plan_utility(task, planner, [SEED], [[]])
    np.testing.assert_array_equal(drives[0], planned.actions[0])
    (row,) = suite.score(Playback(drives, "discrete"), task_id, episodes=1, first_episode=SEED, perturbed=False)
    assert row.value == pytest.approx(float(utility(planned.returns)[0]), abs=1e-4)


@pytest.mark.slow
def test_a_drive_that_is_planned_again_on_the_way_is_at_least_as_good_from_there() -> None:
    task = suite.load().task("U4")
    first, *_, last = task.hidden_weights()
    planner = ScenarioPlanner(task, generations=3, population=128)
    start = planner.start(SEED)
    drive = planner.plan(start, lambda returns: returns @ first[:, None]).actions[0]
    state = planner.after(start, drive[:40])
    assert state["decisions"][0] == 40
    planners = (ScenarioPlanner(task, generations, population=128) for generations in (0, 3))
    kept, again = (each.plan(state, lambda returns: returns @ last[:, None], [drive[40:]]) for each in planners)
    assert again.returns[0] @ last >= kept.returns[0] @ last


@pytest.mark.slow
def test_preferences_are_kept_that_are_worth_knowing() -> None:
    task = suite.load().task("U2")
    planner = ScenarioPlanner(task, generations=3, population=256)
    (drives,), left_out = plan_preferences(task, planner, [SEED], [[]])
    assert 0 < len(drives) - 1 <= 64 - len(left_out)
