"""Hyperparameter search: the points that are proposed from scores."""

from __future__ import annotations

import json
from collections.abc import Mapping
from itertools import count, takewhile
from typing import Any

import optuna
import pytest

from algorithms.studies.plan import propose_points
from algorithms.studies.settings import SearchSettings
from mo_deepdrive.world.config import parse

RATE = "algorithm.learning_rate"
METRIC = "greedy/utility_esr"


def settings_of(**settings: Any) -> SearchSettings:
    """Settings of a search over the learning rate, with changes."""
    space = {RATE: {"low": 1e-4, "high": 1e-2, "log": True}}
    return parse(SearchSettings, {"space": space, "metric": METRIC, "trials": 6, **settings}, "search")


def points(settings: SearchSettings, scores: Mapping[str, float | None] | None = None) -> list[dict[str, Any]]:
    """The proposed points; the run of trial n has the id "n"."""
    known = takewhile(lambda trial: trial in (scores or {}), map(str, count()))
    return propose_points(settings, [(scores or {})[trial] for trial in known])


def test_integer_bounds_give_integers_unless_the_step_is_a_fraction() -> None:
    space = {
        "whole": {"low": 1, "high": 9},
        "halves": {"low": 1, "high": 9, "step": 0.5},
        "real": {"low": 1, "high": 2.0},
    }
    proposed = points(settings_of(space=space, sampler="random", trials=60))
    assert {type(point["whole"]) for point in proposed} == {int}
    assert {point["whole"] for point in proposed} == set(range(1, 10))
    assert any(point["halves"] % 1 == 0.5 for point in proposed)
    assert {type(point["real"]) for point in proposed} == {float}


@pytest.mark.filterwarnings("ignore:Choices for a categorical distribution")
def test_choices_keep_their_types() -> None:
    choices = [None, True, 3, 0.5, "word", [8, 8], {"steps": 8}]
    proposed = points(settings_of(space={"a": choices}, sampler="random", trials=100))
    assert {json.dumps(point["a"]) for point in proposed} == {json.dumps(choice) for choice in choices}


def test_a_random_search_proposes_all_points_at_once_and_ignores_scores() -> None:
    settings = settings_of(sampler="random", trials=20)
    proposed = points(settings)
    assert len(proposed) == 20
    assert points(settings, {str(trial): float(trial) for trial in range(20)}) == proposed
    assert len({point[RATE] for point in proposed}) == 20
    assert points(settings_of(sampler="random", trials=20, seed=1)) != proposed


def test_tpe_proposes_a_batch_once_all_scores_of_the_previous_batches_are_known() -> None:
    settings = settings_of(trials=10, batch=4)
    scores: dict[str, float | None] = {str(trial): float(trial) for trial in range(10)}
    first = points(settings)
    assert len(first) == 4
    for missing in range(4):
        known = {run: score for run, score in scores.items() if run != str(missing)}
        assert points(settings, known) == first
    second = points(settings, {run: scores[run] for run in "0123"})
    assert len(second) == 8
    assert second[:4] == first
    assert len(points(settings, {run: scores[run] for run in "01234567"})) == 10
    assert points(settings, scores)[:8] == second
    assert len(points(settings, scores)) == 10
    assert points(settings_of(trials=10, batch=4, seed=1)) != first


@pytest.fixture
def studies(monkeypatch: pytest.MonkeyPatch) -> list[optuna.Study]:
    """All Optuna studies that are created during the test."""
    made: list[optuna.Study] = []
    create = optuna.create_study

    def keep(**options: Any) -> optuna.Study:
        made.append(create(**options))
        return made[-1]

    monkeypatch.setattr(optuna, "create_study", keep)
    return made


def test_optuna_is_told_the_scores_and_which_points_failed(studies: list[optuna.Study]) -> None:
    scores = {"0": 2.5, "1": None, "2": None, "3": -1.5}
    assert len(points(settings_of(trials=6, batch=4, direction="minimize"), scores)) == 6
    (study,) = studies
    assert study.direction == optuna.study.StudyDirection.MINIMIZE
    states = [trial.state.name for trial in study.trials]
    assert states == ["COMPLETE", "FAIL", "FAIL", "COMPLETE", "RUNNING", "RUNNING"]
    assert [study.trials[trial].value for trial in (0, 3)] == [2.5, -1.5]
