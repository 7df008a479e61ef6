"""Scores: what is made of episodes, how policies of every kind are driven, and what is refused before that."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mo_deepdrive import suite
from mo_deepdrive.suite import Row
from mo_deepdrive.suite.results import check_of_suite
from mo_deepdrive.suite.scorers import SCORERS, controllability

TASKS = suite.load().tasks
BOOK: Any = TASKS["R5"].rulebook


def still(observations: NDArray[Any], *_: Any) -> NDArray[Any]:
    return np.zeros(len(observations), dtype=np.int64)


def driving(observations: NDArray[Any], *_: Any) -> NDArray[Any]:
    return np.full(len(observations), 15)


def number(task_id: str, column: str, samples: Any) -> float:
    task, collected = TASKS[task_id], np.asarray(samples, dtype=np.float64)
    scorer = SCORERS[task.score]
    if column in scorer.further:
        return scorer.further[column](task)(collected)
    return float(scorer.score(task, scorer.part(task, collected).mean(axis=0)))


def test_a_function_is_told_what_has_accrued_without_a_discount() -> None:
    told = []

    def waits(observations: NDArray[Any], accrued: NDArray[Any], _discounts: NDArray[Any]) -> NDArray[Any]:
        told.append(accrued[0, TASKS["smoke"].objectives().index("time")])
        return still(observations)

    suite.score(waits, "smoke", episodes=2, perturbed=False)
    assert told[-1] == pytest.approx(-59.9, abs=0.01)


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
        (2, 0.50, 60.0, 0.0),  # a rule is kept at its limit
        (0, 0.10, BOOK.best, 1.0),
        (0, 0.10, (BOOK.best + BOOK.worst) / 2, 0.5),
        (0, 0.60, BOOK.best, -0.2),  # breaks the second rule by a fifth
        (4, 9.00, BOOK.best, -1.0),  # the first rule that is broken counts alone
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


@pytest.mark.parametrize("column", ["collision", "right_of_way", "time"])
def test_the_costs_of_a_rulebook_are_columns_of_its_task_alone(column: str) -> None:
    row = Row("R5", "mine", 0, "greedy", column, 0.1, version=suite.load().version)
    check_of_suite(row)
    with pytest.raises(ValueError, match=f"column = '{column}' is unknown"):
        check_of_suite(replace(row, task="K1"))


def test_the_worst_family_of_partners_is_the_one_with_the_least_mean() -> None:
    parked, stops, others = [9.0, -9.0, 6.0], [1.0, 3.0, 2.0], [5.0] * 6
    samples = [parked + stops + others, [*parked, 1.0, 1.0, 1.0, *others]]
    assert number("V1", "score", samples) == pytest.approx((2 * 3 + 1.5 * 3 + 5 * 6) / 12)
    assert number("V1", "worst_family", samples) == pytest.approx(1.5)


def test_returns_that_follow_the_weights_are_controllable_and_constant_ones_are_not() -> None:
    task = TASKS["U2"]
    returns = task.hidden_weights()[None].copy()
    returns[..., task.objectives().index("jerk")] = 7.0
    found = controllability(task, returns)
    assert found["controllability/jerk"] == 0.0
    assert found["controllability/time"] == pytest.approx(1.0)


@pytest.mark.slow
def test_the_best_of_a_front_is_taken_for_each_preference() -> None:
    (one, *_), (both, *_), (other, *_) = (
        suite.score(policy, "U2", episodes=8, perturbed=False) for policy in (still, [driving, still], driving)
    )
    assert None not in (one.value, both.value, other.value)
    assert both.value > one.value > other.value  # type: ignore[operator]


@pytest.mark.slow
def test_one_policy_that_is_blind_to_preferences_is_scored_where_they_change_and_a_front_is_not() -> None:
    (blind,), (told,) = (
        suite.score(policy, "U4", episodes=2, perturbed=False)
        for policy in (driving, lambda seen, accrued, discounts, weights: driving(seen))
    )
    assert blind.value == told.value
    with pytest.raises(ValueError, match="preferences that change need a policy that is told them, or a single one"):
        suite.score([still, driving], "U4", episodes=2)


@pytest.mark.slow
@pytest.mark.parametrize("follows", [True, False])
def test_a_policy_is_told_of_a_change_unless_it_keeps_the_first_preference(follows: bool) -> None:
    told: list[Any] = []
    policy = SimpleNamespace(for_preference=lambda weights: told.append(weights) or driving, follows_changes=follows)
    suite.score(policy, "U4", episodes=2, perturbed=False)
    first = TASKS["U4"].told_weights()
    driven = told[-2 * len(first) :]  # whatever it was asked before it drove
    np.testing.assert_array_equal(driven[::2], first)
    np.testing.assert_array_equal(driven[1::2], np.roll(first, -1, axis=0) if follows else first)


@pytest.mark.slow
@pytest.mark.parametrize("task_id", ["K1", "K4", "smoke"])
def test_planned_drives_earn_the_ceiling(task_id: str) -> None:
    (row,) = suite.score(suite.planned(task_id), task_id, perturbed=False)
    assert row.value == pytest.approx(TASKS[task_id].ceiling.value, rel=1e-3)
    assert row.normalised == pytest.approx(1.0, abs=1e-3)


@pytest.mark.slow
def test_a_policy_is_scored_under_perturbations_and_with_strangers() -> None:
    def both_still(observations: NDArray[Any], *_: Any) -> NDArray[Any]:
        return np.zeros(observations.shape[:2], dtype=np.int64)

    rows = {row.column: row for row in suite.score(both_still, "V1", episodes=2, learner="nobody", seed=3)}
    assert list(rows) == ["score", "worst_family", "yaw_friction", "action_delay"]
    assert rows["score"].value == pytest.approx(-60.0, abs=0.01)
    assert rows["score"].normalised == -1.0
    assert rows["worst_family"].normalised is None
    assert {(row.learner, row.seed, row.policy, row.version) for row in rows.values()} == {
        ("nobody", 3, "stochastic", suite.load().version)
    }


@pytest.mark.parametrize(
    ("policy", "task_id", "message"),
    [
        (still, "V1", r"task V1: the policy returned actions of shape \(2,\); expected \(2, 2\) integers"),
        (lambda seen, *_: np.full(len(seen), 40), "K1", "task K1: the policy returned the action 40; it must be from"),
        ([still, driving], "K1", "task K1: a front, or a policy that is told weights, has no place where the utility"),
        ([], "U2", "task U2: the front has no policy"),
    ],
)
def test_a_policy_that_cannot_drive_in_a_task_is_refused(policy: Any, task_id: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        suite.check_policy(policy, task_id)


def test_rows_are_written_and_read_again(tmp_path: Path) -> None:
    rows = [
        Row("K1", "ppo", 3, "greedy", "score", 1.5, 1.25, 1.75, "runs/a", "finished", 12.5, 1),
        Row("K1", "ppo", 4, "", "", None, state="failed", version=suite.load().version),
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


K1 = TASKS["K1"]


def kept(seed: int = 0, episodes: int = K1.episodes) -> suite.Samples:
    return {("K1", "mine/a", seed): np.random.default_rng(seed).normal(5.9, 1.0, (episodes, 1)).astype(np.float32)}


def row_of(samples: suite.Samples) -> Row:
    ((task, learner, seed), part) = next(iter(samples.items()))
    return Row(task, learner, seed, K1.policy, "score", float(part.mean()), version=suite.load().version)


def test_samples_of_scores_are_kept_beside_a_table_in_a_small_file_per_task(tmp_path: Path) -> None:
    samples = kept(1) | kept(2) | {("K5", "ppo", 3): np.ones((9, 1), np.float32)}
    suite.write_samples(tmp_path / "results.csv", samples)
    again = suite.read_samples(tmp_path / "results.csv")
    assert again.keys() == samples.keys()
    assert all(np.array_equal(part, samples[key]) for key, part in again.items())
    assert sorted(file.name for file in (tmp_path / "results_samples").iterdir()) == ["K1.npz", "K5.npz"]
    assert (tmp_path / "results_samples" / "K1.npz").stat().st_size < 2 * (4 * K1.episodes + 400)
    assert suite.read_samples(tmp_path / "other.csv") == {}


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (np.array([[np.nan]], np.float32), r"'a/0' must be finite numbers \(scenarios, k\) of type float32"),
        (np.array([1.0], np.float32), "'a/0' must be finite"),
        (np.array([[print]]), "Object arrays cannot be loaded"),
        (b"PK\x03\x04 and no more", "File is not a zip file"),
        (b"", "No data left in file"),
    ],
)
def test_a_broken_file_of_samples_is_refused_and_runs_no_code(tmp_path: Path, part: Any, message: str) -> None:
    file = tmp_path / "results_samples" / "K1.npz"
    file.parent.mkdir()
    if isinstance(part, bytes):
        file.write_bytes(part)
    else:
        np.savez(file, **{"a/0": part})
    with pytest.raises(ValueError, match=f"K1.npz' is not a file of samples: {message}"):
        suite.read_samples(tmp_path / "results.csv")


def test_samples_belong_to_the_row_whose_score_they_have_and_to_all_scenarios_of_the_task() -> None:
    samples, fewer = kept(), kept(episodes=8)
    assert suite.samples_of([row_of(samples)], samples).keys() == samples.keys()
    assert suite.samples_of([row_of(fewer)], fewer) == {}  # they cannot be compared with others' on the same scenarios
    with pytest.raises(ValueError, match="the samples of mine/a, seed 0, on K1 have the score"):
        suite.samples_of([row_of(fewer)], samples)
