"""Fronts: the numbers of re-evaluated policies, which of them count, and their files."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mo_deepdrive.evaluation.evaluation import Evaluation
from mo_deepdrive.evaluation.front import Front

NAMES = ("speed", "comfort")
ARRAYS = ("returns", "low", "high", "discounted", "success", "length", "conditions")


def episodes(k: int = 3, e: int = 40, seed: int = 0) -> dict[str, Any]:
    """What K policies did in E episodes each, at random, with commands of three numbers."""
    rng = np.random.default_rng(seed)
    return {
        "returns": rng.normal(size=(k, e, 2)) * [1.0, 100.0],
        "discounted": rng.normal(size=(k, e, 2)),
        "lengths": rng.integers(1, 50, (k, e)),
        "succeeded": rng.random((k, e)) < 0.3,
        "conditions": rng.normal(size=(k, 3)),
        "condition_names": ("a", "b", "horizon"),
    }


def make_front(k: int = 3, e: int = 40, seed: int = 0, **changed: Any) -> Front:
    return Front.of_episodes(NAMES, **{**episodes(k, e, seed), **changed}, gamma=0.9, seed=17)


def same(first: Front, second: Front) -> bool:
    """Equal to the last bit, NaN where NaN is."""
    return all(
        np.array_equal(getattr(first, field.name), getattr(second, field.name), equal_nan=True)
        if field.name in ARRAYS
        else getattr(first, field.name) == getattr(second, field.name)
        for field in fields(Front)
    )


# Numbers.


def test_a_policy_has_the_means_of_its_episodes() -> None:
    given, front = episodes(), make_front()
    assert len(front) == 3
    for k in range(3):
        for i in range(2):
            assert front.returns[k, i] == pytest.approx(sum(given["returns"][k, :, i].tolist()) / 40)
            assert front.discounted[k, i] == pytest.approx(sum(given["discounted"][k, :, i].tolist()) / 40)
        assert front.success[k] == pytest.approx(given["succeeded"][k].tolist().count(True) / 40)
        assert front.length[k] == pytest.approx(sum(given["lengths"][k].tolist()) / 40)
    np.testing.assert_array_equal(front.conditions, given["conditions"])
    assert (front.objectives, front.condition_names) == (NAMES, ("a", "b", "horizon"))
    assert (front.gamma, front.episodes, front.seed) == (0.9, 40, 17)


def test_intervals_are_as_wide_as_the_variation_of_the_episodes_implies() -> None:
    front = make_front(e=400)
    expected = 1.96 * episodes(e=400)["returns"].std(axis=1, ddof=1) / 400**0.5
    np.testing.assert_allclose((front.high - front.low) / 2.0, expected, rtol=0.1)
    np.testing.assert_allclose(front.returns - front.low, expected, rtol=0.2)


def make_evaluation(seed: int, arrives: bool, says: bool) -> Evaluation:
    rng = np.random.default_rng(seed)
    returns = rng.normal(size=(3, 1, 2))
    return Evaluation(
        objectives=NAMES,
        utilities=(),
        returns=returns,
        discounted=0.5 * returns,
        lengths=rng.integers(1, 9, (3, 1)),
        succeeded=np.array([[arrives], [False], [False]]),
        ends=np.array([["off_lane" if says else None]] * 3, dtype=object),
        largest=np.abs(returns),
    )


def test_evaluations_become_the_front_of_their_episodes() -> None:
    evaluations = [make_evaluation(k, arrives=k == 1, says=True) for k in range(4)]
    front = Front.of_evaluations(evaluations, [[1.0]] * 4, ("w",), gamma=0.9, seed=3)
    expected = Front.of_episodes(
        NAMES,
        [each.returns[:, 0] for each in evaluations],
        [each.discounted[:, 0] for each in evaluations],
        [each.lengths[:, 0] for each in evaluations],
        [[False] * 3, [True, False, False], [False] * 3, [False] * 3],
        [[1.0]] * 4,
        ("w",),
        gamma=0.9,
        seed=3,
    )
    assert same(front, expected)
    np.testing.assert_allclose(front.success, [0.0, 1 / 3, 0.0, 0.0])


def test_the_front_of_two_vehicles_has_the_objectives_of_both() -> None:
    rng = np.random.default_rng(0)
    returns = rng.normal(size=(2, 3, 2, 2))
    evaluations = [
        Evaluation(
            objectives=NAMES,
            utilities=(),
            returns=each,
            discounted=0.5 * each,
            lengths=np.array([[5, 7], [4, 1], [2, 2]]),
            succeeded=np.array([[True, False], [True, True], [False, False]]),
            ends=np.full((3, 2), "off_lane", dtype=object),
            largest=np.abs(each),
        )
        for each in returns
    ]
    front = Front.of_evaluations(evaluations, gamma=0.9, seed=3)
    assert front.objectives == ("vehicle_0/speed", "vehicle_0/comfort", "vehicle_1/speed", "vehicle_1/comfort")
    np.testing.assert_allclose(front.returns[1], [*returns[1, :, 0].mean(axis=0), *returns[1, :, 1].mean(axis=0)])
    np.testing.assert_allclose(front.discounted, 0.5 * front.returns)
    np.testing.assert_allclose(front.success, 1 / 3)
    np.testing.assert_allclose(front.length, (7 + 4 + 2) / 3)


def test_arrivals_are_unknown_where_the_environment_says_nothing() -> None:
    silent = [make_evaluation(k, arrives=False, says=False) for k in range(2)]
    assert np.isnan(Front.of_evaluations(silent, gamma=0.9, seed=0).success).all()
    arrived = [*silent, make_evaluation(2, arrives=True, says=False)]
    np.testing.assert_allclose(Front.of_evaluations(arrived, gamma=0.9, seed=0).success, [0.0, 0.0, 1 / 3])


def test_dominance_is_determined_by_discounted_returns_and_policies_are_sorted_by_the_first() -> None:
    discounted = np.array([[5.0, 0.0], [1.0, 4.0], [1.0, 3.0], [3.0, 2.0], [5.0, 0.0], [0.0, 4.0]])
    front = make_front(
        6, 1, returns=-discounted[:, None], discounted=discounted[:, None], conditions=np.arange(18).reshape(6, 3)
    )
    kept = front.non_dominated()
    np.testing.assert_array_equal(kept.discounted, [[1.0, 4.0], [3.0, 2.0], [5.0, 0.0]])
    assert same(kept, front.take([1, 3, 0]))
    assert same(kept, kept.non_dominated())


# Files.


@pytest.mark.parametrize(
    "changed",
    [{}, {"succeeded": None}, {"conditions": None, "condition_names": ()}, {"returns": np.full((3, 40, 2), -0.0)}],
    ids=["whole", "no arrivals", "no commands", "zeros"],
)
def test_a_written_front_reads_back_to_the_last_bit(tmp_path: Path, changed: dict[str, Any]) -> None:
    front = make_front(**changed)
    front.write(tmp_path, {"step": 12, "reference_point": None})
    assert same(Front.read(tmp_path), front)
    assert json.loads((tmp_path / "evaluation.json").read_text()) == {
        "step": 12,
        "reference_point": None,
        "gamma": 0.9,
        "episodes": 40,
        "seed": 17,
        "objectives": ["speed", "comfort"],
    }


def edit_json(change: Callable[[dict[str, Any]], Any]) -> Callable[[str], str]:
    def edit(text: str) -> str:
        about = json.loads(text)
        change(about)
        return json.dumps(about)

    return edit


def edit_cell(column: str, value: str) -> Callable[[str], str]:
    def edit(text: str) -> str:
        header, first, *rest = csv.reader(text.splitlines())
        first[header.index(column)] = value
        return "".join(",".join(row) + "\n" for row in (header, first, *rest))

    return edit


@pytest.mark.parametrize(
    ("name", "edit", "message"),
    [
        ("front.csv", lambda text: text[: len(text) - 40], "ValueError"),
        ("front.csv", lambda text: text.replace("\n2,", "\nx,"), "could not convert string to float: 'x'"),
        ("front.csv", lambda text: text.replace("success", "arrived"), "KeyError: 'success'"),
        ("front.csv", edit_cell("return/comfort", "nan"), "return/comfort = nan must be between -1e+100 and 1e+100"),
        ("front.csv", edit_cell("length", "-3"), "length = -3 must be between 1 and 1e+100"),
        ("evaluation.json", edit_json(lambda about: about.update(episodes=0)), "episodes = 0 must be between 1 and"),
        ("front.csv", lambda text: text.replace("success", "length"), "front.csv has two columns of the same name"),
        ("evaluation.json", lambda text: text[:20], "JSONDecodeError"),
        ("evaluation.json", lambda text: "[]", "TypeError"),
        ("evaluation.json", edit_json(lambda about: about.pop("gamma")), "KeyError: 'gamma'"),
        ("evaluation.json", edit_json(lambda about: about["objectives"].append("z")), "KeyError: 'return/z'"),
    ],
)
def test_a_broken_front_is_refused_by_name(tmp_path: Path, name: str, edit: Callable[[str], str], message: str) -> None:
    make_front().write(tmp_path, {})
    path = tmp_path / name
    path.write_text(edit(path.read_text()))
    with pytest.raises(ValueError) as caught:  # noqa: PT011  (the message is looked at below)
        Front.read(tmp_path)
    assert f"the front in {str(tmp_path)!r} is broken: " in str(caught.value)
    assert message in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
