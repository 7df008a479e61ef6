"""The search for planned ceilings: what it finds can be replayed, and is at least as good as what it starts from."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from mo_deepdrive import suite
from mo_deepdrive.evaluation.drives import Playback
from scripts.bounds.plans import PlanEvaluator
from scripts.bounds.suite_bounds import ScenarioPlanner, blind_plan, with_spare_preferences, worth_driving

SEED = 2_000_000


@pytest.mark.slow
@pytest.mark.parametrize("task_id", ["K2", "K3", "K4"])
def test_planned_drives_are_worth_what_the_environment_says(task_id: str) -> None:
    task = suite.load().task(task_id)
    (actions,), (value,) = ScenarioPlanner(task, generations=2, horizon=30.0).plan(SEED)
    drive = Playback([actions], task.config().action_type)
    (row,) = suite.score(drive, task_id, episodes=1, first_episode=SEED, perturbed=False)
    assert row.value == pytest.approx(value, abs=1e-4)


@pytest.mark.slow
def test_the_best_open_loop_sequence_is_no_worse_than_what_it_starts_from() -> None:
    task = suite.load().task("smoke")
    env = gymnasium.make(task.environment.id, disable_env_checker=True)
    starts = []
    for seed in (SEED, SEED + 1):
        env.reset(seed=seed)
        starts.append(env.unwrapped.batch.state[0].copy())  # type: ignore[attr-defined]
    evaluator = PlanEvaluator("one_waypoint", "discrete", 10.0)
    held = [np.full(100, action) for action in (0, 3)]
    actions, worth = blind_plan(evaluator, task.make_utility(), 60.0, starts, held)
    scores = [
        suite.score(drive, "smoke", episodes=2, first_episode=SEED, perturbed=False)[0].value
        for drive in (Playback([actions], "discrete"), *(Playback([each], "discrete") for each in held))
    ]
    assert scores[0] == pytest.approx(worth, abs=1e-4)
    assert scores[0] == max(scores)  # type: ignore[type-var]


def test_preferences_under_which_standing_still_is_nearly_best_are_left_out() -> None:
    task = suite.load().task("U2")
    spare = with_spare_preferences(task)
    still = -60.0 * spare.hidden_weights()[:, -1]
    better = np.ones(len(still))
    better[[3, 40]] = 0.04
    kept, left_out = worth_driving(task, still + better)
    assert left_out == [3, 40]
    assert len(kept) == 64
