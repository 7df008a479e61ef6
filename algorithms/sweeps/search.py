"""Points of a search space by Optuna, in batches, so that they depend on scores alone and not on who is faster."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.sweeps.settings import Range, SearchSettings

if TYPE_CHECKING:
    import optuna

# By run id; None for a run that has failed, or has no finite score.
Scores = Mapping[str, float | None]


def propose(search: SearchSettings, runs_of: Callable[[int, dict[str, Any]], list[str]], scores: Scores) -> None:
    """Choose points until the score of one of them is missing, or all are chosen.

    The same scores give the same points: the whole search is made anew, from its seed.

    Args:
        search: the settings.
        runs_of: called with each trial's number and point (values by key); gives the ids of its runs.
        scores: of the runs that have ended.

    Raises:
        ValueError: if Optuna is not installed, or naming the key whose range it does not take.
    """
    try:
        import optuna
    except ImportError:
        raise ValueError("a search needs Optuna: pip install 'mo-deepdrive[sweep]'") from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=_sampler(search), direction=search.direction)
    space = {key: _distribution(key, values) for key, values in search.space.items()}
    batch = search.batch if search.sampler == "tpe" else search.trials
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


def _sampler(search: SearchSettings) -> optuna.samplers.BaseSampler:
    import optuna

    if search.sampler == "random":
        return optuna.samplers.RandomSampler(seed=search.seed)
    # Points of the same batch have no score yet: constant_liar keeps them apart.
    return optuna.samplers.TPESampler(seed=search.seed, constant_liar=True)


def _distribution(key: str, values: Range) -> optuna.distributions.BaseDistribution:
    import optuna

    if values.choices is not None:
        return optuna.distributions.CategoricalDistribution(values.choices)
    low, high, step = values.low, values.high, values.step
    assert low is not None  # load_sweep has checked
    assert high is not None
    try:
        if isinstance(low, int) and isinstance(high, int) and (step is None or isinstance(step, int)):
            return optuna.distributions.IntDistribution(low, high, log=values.log, step=step or 1)
        return optuna.distributions.FloatDistribution(low, high, log=values.log, step=step)
    except ValueError as error:
        raise ValueError(f"search.space.{key}: {error}") from None
