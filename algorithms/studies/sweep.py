"""From a sweep to its runs: every cell of the grid, or the points that a search with Optuna chooses in each of them.

A search chooses in batches: its points depend on scores alone, not on which run is faster.
"""

from __future__ import annotations

import math
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.runs.config import find_config
from algorithms.studies.execution import Runner
from algorithms.studies.manifest import ManifestRow, Scores, cell_rows, overridden, refuse_duplicates, short_names
from algorithms.studies.sweep_settings import SEED_KEYS, replaced_keys
from mo_deepdrive.support.extras import needed_for
from mo_deepdrive.support.yaml import read_mapping

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import optuna

    from algorithms.studies.sweep_settings import HyperparameterSearchSettings, SearchRange, SweepSettings

MAX_PROBLEMS = 5  # invalid cells that an error message lists


def expand(settings: SweepSettings, scores: Scores) -> list[ManifestRow]:
    """The runs of a sweep; every experiment is resolved, and every cell is built once to check it.

    Args:
        settings: the sweep.
        scores: of the runs that have ended, by id. A search continues from them, so that the last rows are those of
            its unfinished batch.
    """
    bases = {path: read_mapping(find_config(path)) for path in settings.config}
    names = short_names(settings.config)
    rows: list[ManifestRow] = []
    problems: list[str] = []
    combinations = list(product(bases, *settings.grid.values()))
    for path, *values in combinations:
        grid = dict(zip(settings.grid, values, strict=True))
        cell = {"config": names[path], **grid} if len(bases) > 1 else grid
        try:
            base = overridden(bases[path], {**settings.overrides, **grid}, cell)
            if settings.search is not None:
                rows += _search_rows(settings, settings.search, cell, base, scores)
            else:
                asha = settings.ray.asha
                rows += cell_rows(cell, base, settings.seeds, metric=None if asha is None else asha.metric)
        except ValueError as error:
            problems.append(str(error))
    if problems:
        more = len(problems) - MAX_PROBLEMS
        shown = [*problems[:MAX_PROBLEMS], *([f"and {more} more"] if more > 0 else [])]
        raise ValueError(f"{len(problems)} of {len(combinations)} cells are invalid:\n  " + "\n  ".join(shown))
    refuse_duplicates(rows)
    return rows


def _search_rows(
    settings: SweepSettings,
    search: HyperparameterSearchSettings,
    cell: dict[str, Any],
    base: dict[str, Any],
    scores: Scores,
) -> list[ManifestRow]:
    """The rows of a hyperparameter search within one cell of the grid, which are scored on the validation split."""
    evaluation = base.get("evaluation")
    if not isinstance(evaluation, dict) or "split" not in evaluation:
        base = overridden(base, {"evaluation.split": "validation"}, cell)
    rows: dict[str, ManifestRow] = {}

    def runs_of(trial: int, point: dict[str, Any]) -> list[str]:
        point_cell = {**cell, **point}
        values = overridden(base, point, point_cell)
        of_point = cell_rows(point_cell, values, settings.seeds, trial, metric=None if rows else search.metric)
        for row in of_point:
            rows.setdefault(row.id, row)  # a search may choose a point twice
        return [row.id for row in of_point]

    propose_points(search, runs_of, scores)
    return list(rows.values())


def propose_points(
    search: HyperparameterSearchSettings, runs_of: Callable[[int, dict[str, Any]], list[str]], scores: Scores
) -> None:
    """Choose points batch by batch, up to the first batch whose scores are incomplete.

    The search is replayed from its seed on every call, so the same scores give the same points.

    Args:
        search: the settings.
        runs_of: called with each trial's number and point (values by key); returns the ids of its runs.
        scores: of the runs that have ended.
    """
    with needed_for("a search"):
        import optuna
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    if search.sampler == "random":
        sampler: optuna.samplers.BaseSampler = optuna.samplers.RandomSampler(seed=search.seed)
    else:
        # Without constant_liar the points of a batch, which have no scores yet, would be close to each other.
        sampler = optuna.samplers.TPESampler(seed=search.seed, constant_liar=True)
    study = optuna.create_study(sampler=sampler, direction=search.direction)
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
            known = [value for run in runs if (value := scores[run]) is not None]
            if len(known) == len(runs):
                study.tell(trial, float(np.mean(known)))
            else:
                study.tell(trial, state=optuna.trial.TrialState.FAIL)


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


class SweepRunner(Runner):
    """Trains the runs of a sweep; those of a search batch after batch."""

    _settings: SweepSettings

    def expand(self, scores: Scores) -> list[ManifestRow]:
        """As of the base class."""
        return expand(self._settings, scores)

    def announcement(self) -> list[str]:
        """As of the base class: all runs of a search, of which the manifest has one batch."""
        search, settings = self._settings.search, self._settings
        lines = replaced_keys(settings.config, SEED_KEYS)
        if search is not None:
            cells = len(settings.config) * math.prod(map(len, settings.grid.values()))
            runs = cells * search.trials * len(settings.seeds)
            lines.append(f"at most {runs} runs: {cells} searches of {search.trials} points, with every seed")
        return lines

    def metric_of(self, row: ManifestRow) -> str | None:
        """As of the base class."""
        del row
        return None if self._settings.search is None else self._settings.search.metric

    def settled(self, rows: Sequence[ManifestRow]) -> list[ManifestRow]:
        """The runs of a cell's earlier batches: its later ones were chosen with their failures."""
        search = self._settings.search
        assert search is not None
        # Every cell of the grid has a search of its own.
        cells = [str({key: value for key, value in row.cell.items() if key not in search.space}) for row in rows]
        batches = [(row.trial or 0) // search.points_at_a_time for row in rows]
        last: dict[str, int] = {}
        for cell, batch in zip(cells, batches, strict=True):
            last[cell] = max(batch, last.get(cell, 0))
        return [row for row, cell, batch in zip(rows, cells, batches, strict=True) if batch < last[cell]]
