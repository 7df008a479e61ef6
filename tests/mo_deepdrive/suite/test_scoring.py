"""Scores: what is made of episodes, how policies of every kind are driven, and what is refused before that."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mo_deepdrive import suite
from mo_deepdrive.suite import Row
from mo_deepdrive.suite.scorers import SCORERS, controllability

TASKS = suite.load().tasks
BOOK: Any = TASKS["R5"].rulebook


def still(observations: NDArray[Any], *_: Any) -> NDArray[Any]:
    return np.zeros(len(observations), dtype=np.int64)


def faster(observations: NDArray[Any], *_: Any) -> NDArray[Any]:
    return np.full(len(observations), 3)


def number(task_id: str, column: str, samples: Any) -> float:
    task = TASKS[task_id]
    return SCORERS[task.score].numbers[column](task)(np.asarray(samples, dtype=np.float64))


def test_a_mixture_of_drives_is_worth_more_than_its_members_where_the_mean_counts_alone() -> None:
    names = TASKS["K6-SER"].objectives()
    calm = np.array([{"destination": 1.0, "jerk": -24.0}.get(name, 0.0) for name in names])
    arrivals = np.array([calm] * 5 + [0.0 * calm] * 2)  # with probability 1 / (1 + x), x = 0.4
    assert number("K6-SER", "score", [calm]) == pytest.approx(0.6)
    assert number("K6-SER", "score", arrivals) == pytest.approx(1.0 / 1.4)
    utility = TASKS["K6-ESR"].make_utility()
    assert number("K6-ESR", "score", utility(arrivals)) == pytest.approx(0.6 * 5 / 7)


def test_rare_disasters_lower_the_certainty_equivalent_and_the_mean_of_the_worst_tenth() -> None:
    values = np.array([8.0] * 19 + [-40.0])
    utilities = 20.0 * (1.0 - np.exp(-values / 20.0))
    expected = -20.0 * np.log(np.mean(np.exp(-values / 20.0)))
    assert number("K5", "score", utilities) == pytest.approx(expected)
    assert number("K5", "score", utilities) < values.mean()
    assert number("K5", "cvar10", utilities) == pytest.approx(-16.0)


@pytest.mark.parametrize(
    ("collisions", "braking", "time", "score"),
    [
        (0, 0.00, 60.0, 0.0),  # stands still
        (1, 0.25, 60.0, 0.0),  # a rule is kept at its limit
        (0, 0.10, BOOK.best, 1.0),
        (0, 0.10, (BOOK.best + BOOK.worst) / 2, 0.5),
        (0, 0.30, BOOK.best, -0.2),  # breaks the second rule by a fifth
        (2, 9.00, BOOK.best, -1.0),  # the first rule that is broken counts alone
        (9, 0.00, BOOK.best, -1.0),
    ],
)
def test_a_rulebook_scores_the_first_rule_that_is_broken_or_else_the_time(
    collisions: int, braking: float, time: float, score: float
) -> None:
    names = TASKS["R5"].objectives()
    returns = np.zeros((200, len(names)))
    returns[:collisions, names.index("collision")] = -1.0
    returns[:, names.index("right_of_way")], returns[:, names.index("time")] = -braking, -time
    assert number("R5", "score", returns) == pytest.approx(score, abs=1e-6)


def test_the_worst_partner_is_the_one_with_the_least_mean() -> None:
    samples = [[1.0, 5.0, 3.0], [3.0, -3.0, 3.0]]
    assert number("V1", "score", samples) == pytest.approx(2.0)
    assert number("V1", "worst_partner", samples) == pytest.approx(1.0)


def test_returns_that_follow_the_weights_are_controllable_and_constant_ones_are_not() -> None:
    task = TASKS["U2"]
    returns = task.hidden_weights()[None].copy()
    returns[..., 0] = 7.0
    found = controllability(task, returns)
    assert found["controllability/distance"] == 0.0
    assert found["controllability/time"] == pytest.approx(1.0)
    assert found["controllability"] == pytest.approx(1.0 - 1.0 / len(task.objectives()))


@pytest.mark.slow
def test_the_best_of_a_front_is_taken_for_each_preference() -> None:
    (one, *_), (both, *_), (other, *_) = (
        suite.score(policy, "U2", episodes=8, perturbed=False) for policy in (still, [still, faster], faster)
    )
    assert None not in (one.value, both.value, other.value)
    assert both.value > max(one.value, other.value)  # type: ignore[operator, type-var]


@pytest.mark.slow
@pytest.mark.parametrize("task_id", ["K1", "K2", "K3", "K4", "K6-ESR"])
def test_planned_drives_earn_the_ceiling(task_id: str) -> None:
    episodes = 1 if task_id == "K6-ESR" else None
    (row,) = suite.score(suite.planned(task_id), task_id, episodes=episodes, perturbed=False)
    assert row.value == pytest.approx(TASKS[task_id].ceiling.value, rel=1e-3)
    assert row.normalised == pytest.approx(1.0, abs=1e-3)


@pytest.mark.slow
def test_a_policy_is_scored_under_perturbations_and_with_strangers() -> None:
    def both_still(observations: NDArray[Any], *_: Any) -> NDArray[Any]:
        return np.zeros(observations.shape[:2], dtype=np.int64)

    rows = {row.column: row for row in suite.score(both_still, "V1", episodes=2, learner="nobody", seed=3)}
    assert list(rows) == ["score", "worst_partner", "yaw_friction", "action_delay"]
    assert rows["score"].value == pytest.approx(-60.0, abs=0.01)
    assert rows["score"].normalised == -1.0
    assert rows["worst_partner"].normalised is None
    assert {(row.learner, row.seed, row.policy, row.version) for row in rows.values()} == {
        ("nobody", 3, "stochastic", suite.load().version)
    }


@pytest.mark.parametrize(
    ("policy", "task_id", "message"),
    [
        (still, "V1", r"task V1: the policy returned actions of shape \(2,\); expected \(2, 2\) integers"),
        (still, "K2", r"task K2: the policy returned actions of shape \(2,\); expected \(2, 3\) numbers"),
        (lambda seen, *_: np.full(len(seen), 40), "K1", "task K1: the policy returned the action 40; it must be from"),
        ([still, faster], "K1", "task K1: a front, or a policy that is told weights, has no place where the utility"),
        ([], "U2", "task U2: the front has no policy"),
    ],
)
def test_a_policy_that_cannot_drive_in_a_task_is_refused(policy: Any, task_id: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        suite.check_policy(policy, task_id)


def test_rows_are_written_and_read_again(tmp_path: Path) -> None:
    rows = [
        Row("K1", "ppo", 3, "greedy", "score", 1.5, 1.25, 1.75, "runs/a", "finished", 12.5, 1),
        Row("K1", "ppo", 4, "", "", None, state="failed", version=1),
    ]
    suite.write_rows(tmp_path / "rows.csv", rows)
    assert suite.read_rows(tmp_path / "rows.csv") == rows


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a,b\n1,2\n", "its columns must be task, learner, seed"),
        (b"task,learner,seed,policy,column,value\nK1,mine\n", "line 2 must have 6 cells"),
        (
            b"task,learner,seed,policy,column,value\nK1,mine,first,,,\n",
            "line 2: seed = 'first': Input should be a valid integer",
        ),
        (b"\xff\xfe\x00", "'utf-8' codec can't decode"),
    ],
)
def test_another_file_is_not_read(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_bytes(content)
    with pytest.raises(ValueError, match=f"other.csv' is not a table of scores: {message}"):
        suite.read_rows(tmp_path / "other.csv")
