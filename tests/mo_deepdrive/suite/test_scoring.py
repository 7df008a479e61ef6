"""Scores: what is made of episodes, how policies of every kind are driven, and what is refused before that."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mo_deepdrive import suite
from mo_deepdrive.suite.scorers import SCORERS, controllability, policies_of
from mo_deepdrive.suite.scoring import Row

TASKS = suite.load().tasks


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


def test_a_policy_is_told_the_weights_or_picked_from_a_front() -> None:
    told = policies_of(lambda _observations, _accrued, _discounts, weights: weights)
    assert callable(told)
    assert told(np.array([0.25, 0.75]))(None, None, None).tolist() == [0.25, 0.75]  # type: ignore[operator]
    assert policies_of([still, faster]) == [still, faster]
    assert policies_of(still) == [still]


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
        (
            [still, faster],
            "K1",
            "task K1: a front, or a policy that is told weights, has no place where the utility is",
        ),
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
        (b"a,b\n1,2\n", "its columns must be task, learner, seed, .*; they are a, b"),
        (b"task,learner,seed,policy,column,value,value\n", "its columns must be .*; they are .*value, value"),
        (b"", "its columns must be .*; the file is empty"),
        (b"task,learner,seed,policy,column,value\nK1,mine\n", "line 2 must have 6 cells"),
        (b"\xff\xfe\x00", "it is not a text file"),
    ],
)
def test_another_file_is_not_read(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_bytes(content)
    with pytest.raises(ValueError, match=f"other.csv' is not a table of scores: {message}$"):
        suite.read_rows(tmp_path / "other.csv")


VERSION = suite.load().version
SCORED = f"K1,a,0,stochastic,score,1.5,1.25,1.75,run,finished,3.0,{VERSION},1000"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (SCORED.replace("1.5,", "nan,"), "value = nan: Input should be a finite number"),
        (SCORED.replace("1.5,", "inf,"), "value = inf: Input should be a finite number"),
        (SCORED.replace("1.5,", "1e400,"), "value = 1e400: Input should be a finite number"),
        (SCORED.replace("1.25", "-inf"), "low = -inf: Input should be a finite number"),
        (SCORED.replace("a,0", "a,first"), "seed = first: Input should be a valid integer"),
        (SCORED.replace("1.5,", "99,"), "value = 99.0 is outside of its interval from 1.25 to 1.75"),
        (SCORED.replace("1.25", ""), "low and high must both be given, or neither"),
        (SCORED.replace("K1", "K11"), "task 'K11' is unknown; did you mean 'K1'"),
        (SCORED.replace("stochastic", "sampled"), "policy = 'sampled' must be greedy or stochastic"),
        (SCORED.replace("score", "scores"), "column 'scores' of stochastic on K1 is unknown; did you mean 'score'"),
        (SCORED.replace("stochastic,score", "greedy,action_delay"), "column 'action_delay' of greedy on K1 is unknown"),
        (SCORED.replace(f"3.0,{VERSION}", "3.0,99"), f"it is of version 99 of the suite; this is version {VERSION}"),
        (SCORED.replace(f"3.0,{VERSION}", "3.0,0"), "it is of version 0 of the suite"),
        (SCORED.replace(",1000", ",100000000"), "steps = 100,000,000: task K1 allows 3,000,000 environment steps"),
        (SCORED.replace("finished", "failed"), "value = 1.5: a run that failed has none"),
        (SCORED.replace("1.5,1.25,1.75", ",,"), "value is empty; so must be policy, column, low and high"),
        (SCORED.replace("K1,a", "K1,b"), "'b' with seed 0 on K1 has several rows of stochastic score"),
        (SCORED.replace("K1,a", "K1,b").replace("stochastic", "greedy").replace("run", "run_2"), "is of several runs"),
        ("K1,b,1,,,,,,,failed,,0,", "'b' with seed 1 on K1 has several rows of no value"),
        (SCORED.replace("K1,a,0", "K1,b,1"), "'b' with seed 1 on K1 is of several runs: failed .*, finished"),
    ],
)
def test_a_row_that_is_no_score_is_refused_with_its_line(line: str, message: str, tmp_path: Path) -> None:
    names = "task,learner,seed,policy,column,value,low,high,source,state,cpu_seconds,version,steps"
    good = [SCORED.replace("K1,a", "K1,b"), "K1,b,1,,,,,,,failed,,0,"]
    (tmp_path / "rows.csv").write_text("\n".join([names, *good, ""]), encoding="utf-8-sig")  # as Excel writes it
    assert len(suite.read_rows(tmp_path / "rows.csv")) == 2
    (tmp_path / "rows.csv").write_text("\n".join([names, *good, line]))
    with pytest.raises(ValueError, match=rf"^'.*rows.csv': line 4: .*{message}"):
        suite.read_rows(tmp_path / "rows.csv")


def test_every_faulty_row_has_a_line_of_its_own(tmp_path: Path) -> None:
    rows = [Row("K1", "a", seed, "stochastic", "score", float("nan"), version=VERSION) for seed in range(30)]
    suite.write_rows(tmp_path / "rows.csv", rows)
    with pytest.raises(ValueError, match="line 2: .*\n.*line 3: .*\n(.*\n)*and 10 more$"):
        suite.read_rows(tmp_path / "rows.csv")
