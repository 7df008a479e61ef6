"""From a study to its runs: those of the tuning first, and those that count of every arm whose tuning has scores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.runs.config import find_algorithm, find_config, make_experiment
from algorithms.studies.manifest import ManifestRow, Scores, cell_rows, overridden, refuse_duplicates
from mo_deepdrive import suite
from mo_deepdrive.evaluation.metrics import POLICIES, SUITE_SCORE, lower_is_better, split_name
from mo_deepdrive.support.names import nearest, nearest_few
from mo_deepdrive.support.yaml import read_mapping

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from algorithms.runs.config import AlgorithmEntry
    from algorithms.studies.settings import Learner, Study, StudyTask

TASK, LEARNER = "task", "learner"  # keys of every cell


@dataclass(frozen=True)
class Arm:
    """A learner on a task.

    Attributes:
        task, learner: their names.
        label: of the learner.
        metric: of the final evaluation, by which settings are chosen and learners are compared.
        values: the sections of the experiment.
        points: the settings that are tried, values by key; none if the study does not tune.
        tuning_share: of a run's steps, in which they are tried.
        seeds: that count.
    """

    task: str
    learner: str
    label: str
    metric: str
    values: dict[str, Any]
    points: tuple[dict[str, Any], ...]
    tuning_share: float
    seeds: tuple[int, ...]

    @property
    def key(self) -> tuple[str, str]:
        """The names of task and learner."""
        return self.task, self.learner


@dataclass(frozen=True)
class ArmRuns:
    """The runs of an arm that are known by now.

    Attributes:
        arm: whose they are.
        tuning: one per tuning seed of every point.
        scores: mean score of every point; None if a run of it failed, NaN if one has not ended.
        chosen: index of the best point; None while it is not known, or if the study does not tune.
        final: those that count; none while the settings are not chosen.
    """

    arm: Arm
    tuning: tuple[tuple[ManifestRow, ...], ...]
    scores: tuple[float | None, ...]
    chosen: int | None
    final: tuple[ManifestRow, ...]

    @property
    def rows(self) -> list[ManifestRow]:
        """All of them."""
        return [*(row for rows in self.tuning for row in rows), *self.final]

    @property
    def given_up(self) -> bool:
        """Whether no settings can be chosen, because none of those that were tried has a score."""
        return bool(self.tuning) and all(score is None for score in self.scores)


class StudyPlan:
    """The arms of a study.

    Args:
        study: its settings.
        tasks: of the arms that are to be trained now; None for all.
        learners: of these arms; None for all.
        overrides: values of experiment keys for every learner that has them, which count for more than those of the
            study and of the learners.

    Attributes:
        arms: learners on tasks.
        selected: task and learner of those that are to be trained now.
        idle: what has no effect, one line each: a learner that fits no task, a setting that no learner has.
    """

    def __init__(
        self,
        study: Study,
        tasks: Sequence[str] | None = None,
        learners: Sequence[str] | None = None,
        overrides: Mapping[str, Any] | None = None,
    ):
        self.study = study
        self.arms, self.idle = _arms(study, overrides or {})
        for option, given, i in (("--tasks", tasks, 0), ("--learners", learners, 1)):
            known = dict.fromkeys(arm.key[i] for arm in self.arms)
            for name in given or ():
                if name not in known:
                    missing = "no learner of the study is trained on it", "the study has no such learner"
                    raise ValueError(f"{option} {name}: {missing[i]}; {nearest(name, known)}")
        wanted = [arm.key for arm in self.arms if tasks is None or arm.task in tasks]
        self.selected = {key for key in wanted if learners is None or key[1] in learners}
        for name in learners or ():
            if not any(name == key[1] for key in self.selected):
                raise ValueError(f"learner {name!r} fits none of the tasks {', '.join(tasks or study.tasks)}")
        self._rows: dict[tuple[str, str, int | None], tuple[ManifestRow, ...]] = {}
        self._columns_known = False

    def runs(self, scores: Scores) -> list[ArmRuns]:
        """The runs that are known by now, by arm.

        Args:
            scores: of the runs that have ended, by id; None for those that failed.
        """
        return [self._runs_of(arm, scores) for arm in self.arms]

    def rows(self, scores: Scores) -> list[ManifestRow]:
        """The same as the rows of a manifest: those of the tuning first, a run that two arms share once.

        It is then one of an arm that is to be trained now, if any of them is.
        """
        arms = sorted(self.runs(scores), key=lambda runs: runs.arm.key not in self.selected)
        self._check_columns([runs.rows[0] for runs in arms])
        tuning = [row for arm in arms for rows in arm.tuning for row in rows]
        by_id: dict[str, ManifestRow] = {}
        for row in [*tuning, *(row for arm in arms for row in arm.final)]:
            by_id.setdefault(row.id, row)
        return list(by_id.values())

    def _check_columns(self, rows: Sequence[ManifestRow]) -> None:
        """Refuse a column that no run has, of arms that are to be trained now or, if need be, of others."""
        if self._columns_known:
            return
        from algorithms.runs.report import final_metrics

        known: set[str] = set()
        for row in rows:
            if known.issuperset(self.study.columns):
                break
            known |= {name.partition("/")[2] for name in final_metrics(make_experiment(row.config, here=False))}
        for column in self.study.columns:
            if column not in known:
                raise ValueError(
                    f"columns has {column!r}, which no run has; the nearest ones: {nearest_few(column, known)}"
                )
        self._columns_known = True

    def announcement(self) -> str:
        """All runs of the arms that are to be trained now, in a line."""
        arms = [arm for arm in self.arms if arm.key in self.selected]
        tried = sum(len(arm.points) for arm in arms) * len(self.study.tuning.seeds if self.study.tuning else ())
        counted = sum(len(arm.seeds) for arm in arms)
        learners, tasks = (", ".join(dict.fromkeys(arm.key[i] for arm in arms)) for i in (1, 0))
        runs = f"{tried} runs of tuning, then {counted}" if tried else f"{counted} runs, without tuning,"
        return f"{runs} that count: {learners} on {tasks}"

    def _runs_of(self, arm: Arm, scores: Scores) -> ArmRuns:
        tuning = tuple(self._cell(arm, trial) for trial in range(len(arm.points)))
        refuse_duplicates([row for rows in tuning for row in rows])
        means = tuple(_mean([scores.get(row.id, np.nan) for row in rows]) for rows in tuning)
        known = [score for score in means if score is not None]
        if not arm.points:
            return ArmRuns(arm, (), (), None, self._cell(arm, None))
        if not known or np.isnan(known).any():
            return ArmRuns(arm, tuning, means, None, ())
        chosen = means.index((min if lower_is_better(arm.metric) else max)(known))
        return ArmRuns(arm, tuning, means, chosen, self._cell(arm, None, chosen))

    def _cell(self, arm: Arm, trial: int | None, chosen: int | None = None) -> tuple[ManifestRow, ...]:
        """The rows of a point of the tuning, or those that count with the chosen point; every cell is checked once."""
        key = (*arm.key, trial if chosen is None else -1 - chosen)
        if key not in self._rows:
            index = trial if trial is not None else chosen
            point = {} if index is None else arm.points[index]
            cell = {TASK: arm.task, LEARNER: arm.learner, **point}
            split = "test" if trial is None else "validation"
            values = overridden(arm.values, {**point, "evaluation.split": split}, cell)
            seeds = arm.seeds
            if trial is not None:
                assert self.study.tuning is not None
                seeds = tuple(self.study.tuning.seeds)
                if isinstance(steps := values.get("training", {}).get("total_timesteps"), (int, float)):
                    values["training"]["total_timesteps"] = max(1, round(arm.tuning_share * steps))
            build_once = arm.key in self.selected  # others may need what is not installed here
            rows = cell_rows(cell, values, seeds, trial, metric=arm.metric, build_once=build_once)
            self._rows[key] = tuple(rows)
        return self._rows[key]


def _mean(scores: Sequence[float | None]) -> float | None:
    """The mean of the scores of a point; None if a run failed, NaN if one has not ended."""
    known = [score for score in scores if score is not None]
    return float(np.mean(known)) if len(known) == len(scores) else None


def _arms(study: Study, overrides: Mapping[str, Any]) -> tuple[tuple[Arm, ...], list[str]]:
    """The arms of a study, and what has no effect."""
    arms: list[Arm] = []
    unused = {*overrides, *study.help, *(key for task in study.tasks.values() for key in task.help)}
    known: set[str] = set()
    for name, task in study.tasks.items():
        for key, learner in study.learners_of(name).items():
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
            known |= {f"algorithm.{setting}" for setting in entry.config_class.model_fields}
            values = _on_task(values, task)
            for changes in (study.overrides, task.overrides, help_, learner.overrides, given):
                values = overridden(values, changes, {TASK: name, LEARNER: key})
            points, seeds = tuple(study.points(learner)), tuple(task.seeds or study.seeds)
            for tried in points[0] if points else ():
                if not _has(entry, tried):
                    raise ValueError(
                        f"{where}: the study tunes {tried!r}, a setting that it does not have; give it values of its "
                        "own that are tried, or train it without learners that are tuned"
                    )
                if tried in given:
                    raise ValueError(f"{tried} = {given[tried]!r}: the study tunes it for {where}")
            share = learner.tuning_share or (study.tuning.share if study.tuning else 1.0)
            arms.append(Arm(name, key, learner.label or key, _metric(study, name), values, points, share, seeds))
    if not arms:
        raise ValueError(f"no learner fits any of the tasks {', '.join(study.tasks)}")
    learners = {key for name in study.tasks for key in study.learners_of(name)} - {arm.learner for arm in arms}
    idle = [f"learner {key!r} fits none of the tasks" for key in sorted(learners)]
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


def _has(entry: AlgorithmEntry, key: str) -> bool:
    """Whether a key is a setting of an algorithm, or not in the section of the algorithm at all."""
    section, _, rest = key.partition(".")
    return section != "algorithm" or rest.partition(".")[0] in entry.config_class.model_fields


def _metric(study: Study, name: str) -> str:
    """The metric of a task."""
    task = study.tasks[name]
    default = study.metric
    if task.task is not None:
        default = f"{suite.load().task(task.task).policy}/{SUITE_SCORE}"
    metric = task.metric or default
    if metric is None:
        raise ValueError(f"task {name!r} has no metric; give one to it or to the study")
    if not split_name(metric).policy:
        raise ValueError(f"task {name!r}: metric = {metric!r} must begin with a policy, one of {', '.join(POLICIES)}")
    return metric
