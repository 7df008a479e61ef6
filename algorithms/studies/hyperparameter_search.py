"""Hyperparameter search with Optuna, in batches: the points depend on scores alone, not on which run is faster."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.support.extras import needed_for

if TYPE_CHECKING:
    import optuna

    from algorithms.studies.sweep_settings import HyperparameterSearchSettings, SearchRange

# Score by run id; None for a run that failed or has no finite score.
Scores = Mapping[str, float | None]


def propose_points(
    search: HyperparameterSearchSettings, runs_of: Callable[[int, dict[str, Any]], list[str]], scores: Scores
) -> None:
    """Choose points batch by batch, up to the first batch whose scores are incomplete.

    The search is replayed from its seed on every call, so the same scores give the same points.

    Args:
        search: the settings.
        runs_of: called with each trial's number and point (values by key); returns the ids of its runs.
        scores: of the runs that have ended.

    Raises:
        MissingExtraError: if Optuna is not installed.
        ValueError: naming the key whose range Optuna rejects.
    """
    with needed_for("a search"):
        import optuna
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=_sampler(search), direction=search.direction)
    space = {key: _distribution(key, values) for key, values in search.space.items()}
    batch = search.points_at_a_time
    for first in range(0, search.trials, batch):
        asked = []
        for _ in range(min(batch, search.trials - first)):
            trial = study.ask(space)
            asked.append((trial, runs_of(trial.number, dict(trial.params))))
        if any(run not in scores for _, runs in asked for run in runs):
            return
        for trial, runs in asked:
            values = [scores[run] for run in runs]
            known = [value for value in values if value is not None]
            if len(known) == len(values):
                study.tell(trial, float(np.mean(known)))
            else:
                study.tell(trial, state=optuna.trial.TrialState.FAIL)


def _sampler(search: HyperparameterSearchSettings) -> optuna.samplers.BaseSampler:
    import optuna

    if search.sampler == "random":
        return optuna.samplers.RandomSampler(seed=search.seed)
    # Without constant_liar the points of a batch, which have no scores yet, would be close to each other.
    return optuna.samplers.TPESampler(seed=search.seed, constant_liar=True)


def _distribution(key: str, values: SearchRange) -> optuna.distributions.BaseDistribution:
    import optuna

    if values.choices is not None:
        return optuna.distributions.CategoricalDistribution(values.choices)
    low, high, step = values.low, values.high, values.step
    assert low is not None  # checked by load_sweep
    assert high is not None
    try:
        if isinstance(low, int) and isinstance(high, int) and (step is None or isinstance(step, int)):
            return optuna.distributions.IntDistribution(low, high, log=values.log, step=step or 1)
        return optuna.distributions.FloatDistribution(low, high, log=values.log, step=step)
    except ValueError as error:
        raise ValueError(f"search.space.{key}: {error}") from None
