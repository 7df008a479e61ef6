"""From a sweep or study to its runs, which are known batch by batch where scores decide which settings are next.

A sweep has a cell for every combination of its grid, or the points that Optuna chooses in each. A study has arms, each
a learner on a task: first the settings that are tried, then the runs that count with the best of them. What is chosen
depends on scores alone, not on which run is faster.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.runs.config import CONFIGS, find_algorithm, find_config
from algorithms.studies import ALL, CORE, REFERENCE
from algorithms.studies.manifest import (
    ManifestRow,
    Scores,
    cell_rows,
    overridden,
    refuse_duplicates,
    short_names,
)
from algorithms.studies.settings import (
    ELSEWHERE,
    SEED_KEYS,
    Learner,
    StudyTask,
    key_problems,
    keys_in,
    learners_in,
    load_study,
    problems_of,
    replaced_keys,
)
from mo_deepdrive import suite
from mo_deepdrive.evaluation.metrics import SUITE_SCORE, lower_is_better
from mo_deepdrive.support.extras import needed_for
from mo_deepdrive.support.names import nearest, nearest_few
from mo_deepdrive.support.yaml import read_mapping

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import optuna

    from algorithms.studies.settings import PlanSettings, SearchRange, SearchSettings, Study, SweepSettings

TASK, LEARNER = "task", "learner"  # keys of every cell of a study


class Plan(ABC):
    """The runs of a sweep or study."""

    def __init__(self, settings: PlanSettings) -> None:
        self.settings = settings
        self._cells: dict[str, list[ManifestRow]] = {}

    @abstractmethod
    def rows(self, scores: Scores) -> list[ManifestRow]:
        """The runs that are known by now."""

    @abstractmethod
    def announcement(self) -> list[str]:
        """What is said before anything is trained, one line each."""

    def wanted(self, row: ManifestRow) -> bool:
        """Whether a run is to be trained now."""
        del row
        return True

    def _cell(self, cell: dict[str, Any], trial: int | None, **arguments: Any) -> list[ManifestRow]:
        """The rows of a cell, which is checked and built once; the arguments are those of ``cell_rows``."""
        key = repr((cell, trial))
        if key not in self._cells:
            self._cells[key] = cell_rows(cell, trial=trial, **arguments)
        return self._cells[key]


def _once(rows: Iterable[ManifestRow]) -> list[ManifestRow]:
    """The first row of every run."""
    by_id: dict[str, ManifestRow] = {}
    for row in rows:
        by_id.setdefault(row.id, row)
    return list(by_id.values())


# ------------------------------------------------------------------------------------------------------------- a sweep


class SweepPlan(Plan):
    """The cells of a sweep, each of which may have a search."""

    settings: SweepSettings

    def rows(self, scores: Scores) -> list[ManifestRow]:
        """As of the base class."""
        settings = self.settings
        bases, names = {path: read_mapping(find_config(path)) for path in settings.config}, short_names(settings.config)
        metric = settings.ray.asha and settings.ray.asha.metric
        rows: list[ManifestRow] = []
        for path, *values in product(bases, *settings.grid.values()):
            grid = dict(zip(settings.grid, values, strict=True))
            cell = {"config": names[path], **grid} if len(bases) > 1 else grid
            sections = overridden(bases[path], {**settings.overrides, **grid}, cell)
            if settings.search is None:
                rows += self._cell(cell, None, values=sections, seeds=settings.seeds, metric=metric)
            else:
                rows += self._search_rows(settings.search, cell, sections, scores)
        refuse_duplicates(rows)
        return rows

    def announcement(self) -> list[str]:
        """As of the base class: all runs of a search, of which the manifest has one batch."""
        settings, search = self.settings, self.settings.search
        lines = replaced_keys(settings.config, SEED_KEYS)
        if search is not None:
            cells = len(settings.config) * math.prod(map(len, settings.grid.values()))
            runs = cells * search.trials * len(settings.seeds)
            lines.append(f"at most {runs} runs: {cells} searches of {search.trials} points, with every seed")
        return lines

    def _search_rows(
        self, search: SearchSettings, cell: dict[str, Any], values: dict[str, Any], scores: Scores
    ) -> list[ManifestRow]:
        """The rows of a search within a cell of the grid, up to the first batch of which a run has not ended."""
        evaluation = values.get("evaluation")
        if not isinstance(evaluation, dict) or "split" not in evaluation:
            values = overridden(values, {"evaluation.split": "validation"}, cell)
        by_point: list[list[ManifestRow]] = []
        means: list[float | None] = []
        first = 0  # of the last batch
        while points := propose_points(search, means)[len(by_point) :]:
            batch = []
            for trial, point in enumerate(points, len(by_point)):
                keys = {**cell, **point}
                sections, metric = overridden(values, point, keys), None if trial else search.metric
                batch.append(self._cell(keys, trial, values=sections, seeds=self.settings.seeds, metric=metric))
            earlier, later = ([row for rows in part for row in rows] for part in (by_point[first:], batch))
            if not scores.settle(earlier, later):
                break
            first = len(by_point)
            by_point += batch
            means += [scores.mean(rows, search.metric) for rows in batch]
            if any(mean is not None and math.isnan(mean) for mean in means):
                break
        return _once(row for rows in by_point for row in rows)  # a search may choose a point twice


def propose_points(search: SearchSettings, scores: Sequence[float | None]) -> list[dict[str, Any]]:
    """The points of a search, replayed from its seed, up to the first batch whose scores are not all there."""
    with needed_for("a search"):
        import optuna
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler: optuna.samplers.BaseSampler = optuna.samplers.RandomSampler(seed=search.seed)
    size = search.trials
    if search.sampler == "tpe":
        # Without constant_liar the points of a batch, which have no scores yet, would be close to each other.
        sampler, size = optuna.samplers.TPESampler(seed=search.seed, constant_liar=True), search.batch
    study = optuna.create_study(sampler=sampler, direction=search.direction)
    space = {key: _distribution(key, values) for key, values in search.space.items()}
    points: list[dict[str, Any]] = []
    for first in range(0, search.trials, size):
        trials = [study.ask(space) for _ in range(min(size, search.trials - first))]
        points += [dict(trial.params) for trial in trials]
        if len(scores) < len(points):
            break
        for trial, score in zip(trials, scores[first:], strict=False):
            study.tell(trial, score, optuna.trial.TrialState.FAIL if score is None else None)
    return points


def _distribution(key: str, values: SearchRange) -> optuna.distributions.BaseDistribution:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if values.choices is not None:
        return CategoricalDistribution(values.choices)
    bounds: tuple[Any, Any] = values.low, values.high  # not None: checked by the settings
    step: Any = values.step
    try:
        if all(isinstance(number, int) for number in (*bounds, step or 1)):
            return IntDistribution(*bounds, log=values.log, step=1 if step is None else step)
        return FloatDistribution(*bounds, log=values.log, step=step)
    except ValueError as error:
        raise ValueError(f"search.space.{key}: {error}") from None


# ------------------------------------------------------------------------------------------------------------- a study


@dataclass(frozen=True)
class Arm:
    """A learner on a task."""

    task: str
    learner: str
    label: str
    metric: str  # of the final evaluation, by which settings are chosen and learners are compared
    values: dict[str, Any]  # the sections of its experiment
    points: tuple[dict[str, Any], ...]  # values by key that are tried for it
    tuning_share: float
    seeds: tuple[int, ...]

    @property
    def key(self) -> tuple[str, str]:
        """The names of task and learner."""
        return self.task, self.learner


@dataclass(frozen=True)
class ArmRuns:
    """The runs of an arm that are known by now: those of every point of its tuning, and the final ones, which count."""

    arm: Arm
    tuning: tuple[list[ManifestRow], ...]
    scores: tuple[float | None, ...]  # the mean of every point; None if a run of it failed, NaN if one has not ended
    chosen: int | None  # index of the best point; None while it is not known, or if the study does not tune
    final: list[ManifestRow]

    @property
    def rows(self) -> list[ManifestRow]:
        """All of them."""
        return [*(row for rows in self.tuning for row in rows), *self.final]

    @property
    def given_up(self) -> bool:
        """Whether no settings can be chosen, because none of those that were tried has a score."""
        return bool(self.tuning) and all(score is None for score in self.scores)


class StudyPlan(Plan):
    """The arms of a study; those of some tasks and learners are ``selected``, to be trained now.

    ``overrides`` are values of experiment keys for every learner that has them, which count for more than those of the
    study and of the learners. ``idle`` has lines about learners that fit no task and settings that no learner has.
    """

    def __init__(
        self,
        study: Study,
        tasks: Sequence[str] | None = None,
        learners: Sequence[str] | None = None,
        overrides: Mapping[str, Any] | None = None,
    ):
        super().__init__(study)
        self.study = study
        self.arms, self.idle = _arms(study, overrides or {})
        missing = "no learner of the study is trained on it", "the study has no such learner"
        for option, given, i in (("--tasks", tasks, 0), ("--learners", learners, 1)):
            known = dict.fromkeys(arm.key[i] for arm in self.arms)
            for name in (name for name in given or () if name not in known):
                raise ValueError(f"{option} {name}: {missing[i]}; {nearest(name, known)}")
        on_tasks = [arm.key for arm in self.arms if tasks is None or arm.task in tasks]
        self.selected = {key for key in on_tasks if learners is None or key[1] in learners}
        for name in learners or ():
            if not any(name == key[1] for key in self.selected):
                raise ValueError(f"learner {name!r} fits none of the tasks {', '.join(tasks or study.tasks)}")

    def wanted(self, row: ManifestRow) -> bool:
        """As of the base class: whether its arm is selected."""
        return (str(row.cell.get(TASK)), str(row.cell.get(LEARNER))) in self.selected

    def runs(self, scores: Scores | None = None) -> list[ArmRuns]:
        """The runs that are known by now, by arm."""
        return [self._runs_of(arm, scores or Scores()) for arm in self.arms]

    def rows(self, scores: Scores) -> list[ManifestRow]:
        """As of the base class: those of the tuning first; a run that arms share is one of a selected arm."""
        arms = sorted(self.runs(scores), key=lambda runs: runs.arm.key not in self.selected)
        self._check_columns([runs.rows[0] for runs in arms])
        tuning = [row for arm in arms for rows in arm.tuning for row in rows]
        return _once([*tuning, *(row for arm in arms for row in arm.final)])

    def announcement(self) -> list[str]:
        """As of the base class: all runs of the arms that are to be trained now, in a line."""
        arms = [arm for arm in self.arms if arm.key in self.selected]
        tried = sum(len(arm.points) for arm in arms) * len(self.study.tuning.seeds if self.study.tuning else ())
        counted = sum(len(arm.seeds) for arm in arms)
        learners, tasks = (", ".join(dict.fromkeys(arm.key[i] for arm in arms)) for i in (1, 0))
        runs = f"{tried} runs of tuning, then {counted}" if tried else f"{counted} runs, without tuning,"
        replaced = replaced_keys((learner.config for _, learner in learners_in(self.study)), ELSEWHERE)
        return [*replaced, f"{runs} that count: {learners} on {tasks}"]

    def _check_columns(self, rows: Sequence[ManifestRow]) -> None:
        """Refuse a column that no run has, of arms that are to be trained now or, if need be, of others."""
        from algorithms.runs.report import final_metric_names

        known: set[str] = set()
        for row in rows:
            if known.issuperset(self.study.columns):
                return
            known |= {name.partition("/")[2] for name in final_metric_names(row.experiment)}
        for column in self.study.columns:
            if column not in known:
                near = nearest_few(column, known)
                raise ValueError(f"columns has {column!r}, which no run has; the nearest ones: {near}")

    def _runs_of(self, arm: Arm, scores: Scores) -> ArmRuns:
        tuning = tuple(self._rows_of(arm, point, trial) for trial, point in enumerate(arm.points))
        if not tuning:
            return ArmRuns(arm, (), (), None, self._rows_of(arm, {}))
        tried = [row for rows in tuning for row in rows]
        refuse_duplicates(tried)
        means = tuple(scores.mean(rows, arm.metric) for rows in tuning)
        known = [score for score in means if score is not None]
        if known and not np.isnan(known).any():
            chosen = means.index((min if lower_is_better(arm.metric) else max)(known))
            final = self._rows_of(arm, arm.points[chosen])
            if scores.settle(tried, final):
                return ArmRuns(arm, tuning, means, chosen, final)
        return ArmRuns(arm, tuning, means, None, [])

    def _rows_of(self, arm: Arm, point: dict[str, Any], trial: int | None = None) -> list[ManifestRow]:
        """The rows of a point that is tried, or those that count with the chosen point."""
        cell, seeds = {TASK: arm.task, LEARNER: arm.learner, **point}, arm.seeds
        split = "test" if trial is None else "validation"
        values = overridden(arm.values, {**point, "evaluation.split": split}, cell)
        if trial is not None and self.study.tuning is not None:
            seeds = tuple(self.study.tuning.seeds)
            if isinstance(steps := values.get("training", {}).get("total_timesteps"), (int, float)):
                values["training"]["total_timesteps"] = max(1, round(arm.tuning_share * steps))
        build_once = arm.key in self.selected  # others may need what is not installed here
        return self._cell(cell, trial, values=values, seeds=seeds, metric=arm.metric, build_once=build_once)


def _arms(study: Study, overrides: Mapping[str, Any]) -> tuple[tuple[Arm, ...], list[str]]:
    """The arms of a study, and what has no effect."""
    arms: list[Arm] = []
    unused = {*overrides, *study.help, *(key for task in study.tasks.values() for key in task.help)}
    known: set[str] = set()
    learners: set[str] = set()
    for name, task in study.tasks.items():
        for key, learner in study.learners_of(name).items():
            learners.add(key)
            where = f"learner {key!r} on task {name!r}"
            values = _base(learner, where)
            entry = find_algorithm(values["algorithm"]["name"], where)
            if task.task is not None and entry.known_utility != (suite.load().task(task.task).utility is not None):
                if key in task.learners:
                    raise ValueError(f"{where}: it learns for {'a' if entry.known_utility else 'no'} known utility")
                continue
            help_, given = (
                {setting: value for setting, value in settings.items() if _has(entry, setting)}
                for settings in ({**study.help, **task.help}, overrides)
            )
            unused -= {*help_, *given}
            known |= {f"algorithm.{setting}" for setting in entry.Config.model_fields}
            values = _on_task(values, task)
            for changes in (study.overrides, task.overrides, help_, learner.overrides, given):
                values = overridden(values, changes, {TASK: name, LEARNER: key})
            points, seeds = tuple(study.points(learner)), tuple(task.seeds or study.seeds)
            for tried in points[0] if points else ():
                if not _has(entry, tried):
                    hint = "give it values of its own that are tried, or train it without learners that are tuned"
                    raise ValueError(f"{where}: the study tunes {tried!r}, a setting that it does not have; {hint}")
                if tried in given:
                    raise ValueError(f"{tried} = {given[tried]!r}: the study tunes it for {where}")
            of_suite = task.task and f"{suite.load().task(task.task).policy}/{SUITE_SCORE}"
            if (metric := task.metric or of_suite or study.metric) is None:
                raise ValueError(f"task {name!r} has no metric; give one to it or to the study")
            share = learner.tuning_share or (study.tuning.share if study.tuning else 1.0)
            arms.append(Arm(name, key, learner.label or key, metric, values, points, share, seeds))
    if not arms:
        raise ValueError(f"no learner fits any of the tasks {', '.join(study.tasks)}")
    idle = [f"learner {key!r} fits none of the tasks" for key in sorted(learners - {arm.learner for arm in arms})]
    hints = {key: f"no learner has the setting {key!r}; {nearest(key, known)}" for key in sorted(unused)}
    for key in (key for key in overrides if key in hints):
        raise ValueError(hints[key])
    return tuple(arms), [*idle, *hints.values()]


def _base(learner: Learner, where: str) -> dict[str, Any]:
    """The sections of a learner's config, with the name of its algorithm."""
    values = {} if learner.config is None else read_mapping(find_config(learner.config))
    section = values.setdefault("algorithm", {})
    if "algorithm.name" in learner.overrides and isinstance(section, dict):
        section["name"] = learner.overrides["algorithm.name"]
    if not isinstance(section, dict) or "name" not in section:
        raise ValueError(f"{where} has no algorithm; give it a config, or algorithm.name in its overrides")
    return values


def _on_task(values: Mapping[str, Any], task: StudyTask) -> dict[str, Any]:
    """The sections of a learner with what its task sets, whose own settings go before those of the suite."""
    known = None if task.task is None else suite.load().task(task.task)
    environment = task.environment or (known and known.environment)
    utility = task.utility or (known and known.utility)
    steps = task.steps or (known and known.steps)
    changed = dict(values)
    if environment is not None:
        changed["environment"] = environment.model_dump(mode="json")
    if utility is not None or known is not None:
        changed["utility"] = utility and utility.model_dump(mode="json")
    if steps is not None:
        changed["training"] = {**(values.get("training") or {}), "total_timesteps": steps}
    if known is not None:
        changed["evaluation"] = {**(values.get("evaluation") or {}), "task": task.task}
    return changed


def _has(entry: Any, key: str) -> bool:
    """Whether a key is a setting of an algorithm, or not in the section of the algorithm at all."""
    section, _, rest = key.partition(".")
    return section != "algorithm" or rest.partition(".")[0] in entry.Config.model_fields


# ------------------------------------------------------------------------------------------------ a study of the suite

# The reference results of the suite, in a checkout and in an installed package.
PUBLISHED = CONFIGS.parent / "docs" / "results" / "suite.csv"
if not PUBLISHED.is_file():
    PUBLISHED = CONFIGS / "suite" / "published.csv"


def selected_tasks(names: Sequence[str]) -> list[str]:
    """The tasks of ids, of "core" and of "all" that count; each of them once."""
    tasks = suite.load().tasks
    groups = {CORE: [key for key in tasks if tasks[key].core], ALL: [key for key in tasks if tasks[key].counted]}
    selected = dict.fromkeys(key for name in names for key in groups.get(name, [name]))
    for key in selected:
        suite.load().task(key)
    return list(selected)


def plan_of(
    learners: list[str], tasks: Sequence[str], seeds: int, overrides: Mapping[str, Any] | None = None
) -> StudyPlan:
    """The study of learners on tasks of the suite (ids, "core" or "all"), with the help of the reference study.

    The learners are some of the reference study, configs and paths of classes. If one of them is of the reference
    study, all are tuned by its rule; else none is.
    """
    if seeds < 1:
        raise ValueError(f"--seeds {seeds} must be at least 1")
    wanted = selected_tasks(tasks)
    reference, names = load_study(REFERENCE), short_names(learners)
    planned = {key for task in reference.tasks for key in reference.learners_of(task)} & {*learners}
    trained = {name: learner for name, learner in reference.learners.items() if name in planned}
    for name in (name for name in learners if name not in planned):
        trained[names[name]] = Learner(overrides={"algorithm.name": name}) if ":" in name else Learner(config=name)
    study_tasks = {}
    for key, task in suite.load().tasks.items():
        given = reference.tasks.get(key, StudyTask(task=key))
        changed = {name: learner for name, learner in given.learners.items() if name in planned}
        study_tasks[key] = given.model_copy(update={"learners": changed, "title": task.title})
    tuning = reference.tuning if planned else None
    changes = {"seeds": list(range(seeds)), "tasks": study_tasks, "learners": trained, "tuning": tuning}
    study = reference.model_copy(update=changes)
    problems = [f"--learner {name} is given twice" for name in names if learners.count(name) > 1]
    problems += key_problems({"the options": keys_in(overrides or {})}, ELSEWHERE)
    asked = {key: study_tasks[key] for key in wanted if study.learners_of(key)}
    problems += problems_of(study.model_copy(update={"tasks": asked}))
    if problems:
        raise ValueError("; ".join(problems))
    return StudyPlan(study, wanted, [*names.values()], overrides)
