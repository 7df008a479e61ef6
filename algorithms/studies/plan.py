"""From a sweep or study to its runs, which are known batch by batch where scores decide which settings are next.

A sweep has a cell for every combination of its grid, or the points that Optuna chooses in each. A study has arms, each
a learner on a task: first the settings that are tried, rung by rung, then the runs that count with the best of them.
What is chosen depends on scores alone, not on which run is faster.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

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
    Tuning,
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
    tuning: Tuning
    candidates: tuple[dict[str, Any], ...]  # values by key that are tried for it, or for the arm that it ablates
    seeds: tuple[int, ...]
    ablation_of: str | None  # the learner on the same task whose chosen candidate it takes

    @property
    def key(self) -> tuple[str, str]:
        """The names of task and learner."""
        return self.task, self.learner


@dataclass(frozen=True)
class ArmRuns:
    """The runs of an arm that are known by now: those of every rung of its tuning, and the final ones, which count."""

    arm: Arm
    tuning: list[ManifestRow]  # rung by rung, whose number is in their cells
    chosen: int | None  # index of the best candidate; None while it is not known, or if the study does not tune
    final: list[ManifestRow]
    given_up: bool = False  # whether no candidate can be chosen, because none that was tried in a rung has a score

    @property
    def rows(self) -> list[ManifestRow]:
        """All of them."""
        return [*self.tuning, *self.final]


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
        on_tasks = [arm for arm in self.arms if tasks is None or arm.task in tasks]
        if study.tuning is not None:
            self._check_candidates(on_tasks)
        chosen = [arm for arm in on_tasks if learners is None or arm.learner in learners]
        # Without what it ablates an ablation says nothing.
        self.selected = {(arm.task, name) for arm in chosen for name in (arm.learner, arm.ablation_of) if name}
        for name in learners or ():
            if not any(name == key[1] for key in self.selected):
                raise ValueError(f"learner {name!r} fits none of the tasks {', '.join(tasks or study.tasks)}")

    def wanted(self, row: ManifestRow) -> bool:
        """As of the base class: whether its arm is selected."""
        return (str(row.cell.get(TASK)), str(row.cell.get(LEARNER))) in self.selected

    def runs(self, scores: Scores | None = None) -> list[ArmRuns]:
        """The runs that are known by now, by arm."""
        scores = scores or Scores()
        tuned = {arm.key: self._runs_of(arm, scores) for arm in self.arms if arm.ablation_of is None}
        return [
            tuned[arm.key] if arm.ablation_of is None else self._ablation(arm, tuned[arm.task, arm.ablation_of])
            for arm in self.arms
        ]

    def rows(self, scores: Scores) -> list[ManifestRow]:
        """As of the base class: those of the tuning first; a run that arms share is one of a selected arm."""
        arms = sorted(self.runs(scores), key=lambda runs: runs.arm.key not in self.selected)
        self._check_columns([row for arm in arms for row in arm.rows[:1]])
        return _once([*(row for arm in arms for row in arm.tuning), *(row for arm in arms for row in arm.final)])

    def announcement(self) -> list[str]:
        """As of the base class: all runs of the arms that are to be trained now, in a line."""
        arms = [arm for arm in self.arms if arm.key in self.selected]
        rungs = [
            (len(arm.tuning.seeds) * size, share)
            for arm in arms
            if arm.ablation_of is None
            for share, size in arm.tuning.rungs(len(arm.candidates))
        ]
        tried, length = sum(runs for runs, _ in rungs), sum(runs * share for runs, share in rungs)
        counted = sum(len(arm.seeds) for arm in arms)
        learners, tasks = (", ".join(dict.fromkeys(arm.key[i] for arm in arms)) for i in (1, 0))
        tuning = f"{tried} runs of tuning, as long as {length:g} full ones, then {counted}"
        runs = tuning if tried else f"{counted} runs, without tuning,"
        replaced = replaced_keys((learner.config for _, learner in learners_in(self.study)), ELSEWHERE)
        return [*replaced, f"{runs} that count: {learners} on {tasks}"]

    def _check_candidates(self, arms: Sequence[Arm]) -> None:
        """Refuse arms of a task with more or fewer candidates than others, since all else of their tuning is equal."""
        for task in dict.fromkeys(arm.task for arm in arms):
            tuned = [arm for arm in arms if (arm.task, arm.ablation_of) == (task, None)]
            numbers = {arm.learner: len(arm.candidates) for arm in tuned}
            wanted = tuned[0].tuning.candidates or max(1, *numbers.values())
            if {*numbers.values()} != {wanted}:
                listed = ", ".join(f"{learner} {number}" for learner, number in numbers.items())
                hint = "tuning.values, or the tuning of a learner, must have as many combinations"
                needed = f"every learner must have the same number of candidates, {wanted}, not {listed}"
                raise ValueError(f"task {task!r}: {needed}; {hint}")

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
        if not arm.candidates:
            return ArmRuns(arm, [], None, self._rows_of(arm, {}))
        tried: list[ManifestRow] = []
        last: list[ManifestRow] = []  # of them, those of the last rung
        best_first = [*range(len(arm.candidates))]
        for number, (_, size) in enumerate(arm.tuning.rungs(len(arm.candidates))):
            by_candidate = {i: self._rows_of(arm, arm.candidates[i], i, number) for i in best_first[:size]}
            rung = [row for rows in by_candidate.values() for row in rows]
            refuse_duplicates(rung)
            if not scores.settle(last, rung):
                return ArmRuns(arm, tried, None, [])
            last, tried = rung, [*tried, *rung]
            means = {i: scores.mean(rows, arm.metric) for i, rows in by_candidate.items()}
            known = {i: mean for i, mean in means.items() if mean is not None}
            if not known or any(map(math.isnan, known.values())):
                return ArmRuns(arm, tried, None, [], given_up=not known)
            best_first = sorted(known, key=known.__getitem__, reverse=not lower_is_better(arm.metric))
        final = self._rows_of(arm, arm.candidates[best_first[0]])
        settled = scores.settle(last, final)
        return ArmRuns(arm, tried, best_first[0] if settled else None, final if settled else [])

    def _ablation(self, arm: Arm, ablated: ArmRuns) -> ArmRuns:
        """The runs of an ablation, with what was chosen for the arm that it ablates; before that they are checked."""
        chosen = ablated.chosen or 0
        theirs, rows = (
            self._rows_of(its, its.candidates[chosen] if its.candidates else {}) for its in (ablated.arm, arm)
        )
        refuse_duplicates([*theirs, *rows])
        return ArmRuns(arm, [], ablated.chosen, rows if ablated.final else [], ablated.given_up)

    def _rows_of(
        self, arm: Arm, candidate: dict[str, Any], trial: int | None = None, rung: int = 0
    ) -> list[ManifestRow]:
        """The rows of a candidate that is tried in a rung, or those that count with the chosen one."""
        cell, seeds = {TASK: arm.task, LEARNER: arm.learner, **candidate}, arm.seeds
        split = "test" if trial is None else "validation"
        values = overridden(arm.values, {**candidate, "evaluation.split": split}, cell)
        if trial is not None:
            cell, seeds = {**cell, "rung": rung}, tuple(arm.tuning.seeds)
            if isinstance(steps := values.get("training", {}).get("total_timesteps"), (int, float)):
                values["training"]["total_timesteps"] = max(1, round(arm.tuning.shares[rung] * steps))
        build_once = arm.key in self.selected  # others may need what is not installed here
        return self._cell(cell, trial, values=values, seeds=seeds, metric=arm.metric, build_once=build_once)


def _arms(study: Study, overrides: Mapping[str, Any]) -> tuple[tuple[Arm, ...], list[str]]:
    """The arms of a study, and what has no effect."""
    arms: list[Arm] = []
    tunings = study.tuning, *(task.tuning for task in study.tasks.values())
    tuned_keys = (key for tuning in tunings if tuning is not None for key in tuning.values)
    unused = {*overrides, *study.help, *tuned_keys, *(key for task in study.tasks.values() for key in task.help)}
    known: set[str] = set()
    learners: set[str] = set()
    for name, task in study.tasks.items():
        of_task, tuning = study.learners_of(name), task.tuning or study.tuning or Tuning()
        for key, own in of_task.items():
            learners.add(key)
            where = f"learner {key!r} on task {name!r}"
            tuned = of_task[own.ablation_of or key]
            learner = tuned.with_changes(own)
            values = _base(learner, where)
            entry = find_algorithm(values["algorithm"]["name"], where)
            # Where preferences are hidden, one policy for a utility of the learner's own is blind to them.
            known_there = task.task is None or suite.load().task(task.task).utility is not None
            if task.task is not None and entry.known_utility != (known_there or "utility" in learner.overrides):
                if key in task.learners:
                    raise ValueError(f"{where}: it learns for {'a' if entry.known_utility else 'no'} known utility")
                continue
            help_, given = (
                {setting: value for setting, value in settings.items() if _has(entry, setting)}
                for settings in ({**study.help, **task.help}, overrides)
            )
            tried = {setting: options for setting, options in tuning.values.items() if _has(entry, setting)}
            unused -= {*help_, *given, *tried}
            known |= {f"algorithm.{setting}" for setting in entry.Config.model_fields}
            values = _on_task(values, task)
            for changes in (study.overrides, task.overrides, help_, learner.overrides, given):
                values = overridden(values, changes, {TASK: name, LEARNER: key})
            tried |= tuned.tuning
            for setting in given.keys() & tried.keys():
                raise ValueError(f"{setting} = {given[setting]!r}: the study tunes it for {where}")
            candidates, seeds = tuning.candidates_of(tried), tuple(task.seeds or study.seeds)
            if own.ablation_of is not None:
                fixed = keys_in(own.overrides)
                candidates = [{key: value for key, value in point.items() if key not in fixed} for point in candidates]
            of_suite = task.task and f"{suite.load().task(task.task).policy}/{SUITE_SCORE}"
            if (metric := task.metric or of_suite or study.metric) is None:
                raise ValueError(f"task {name!r} has no metric; give one to it or to the study")
            arms.append(
                Arm(name, key, own.label or key, metric, values, tuning, tuple(candidates), seeds, own.ablation_of)
            )
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
    known = {key: its for task in reference.tasks for key, its in reference.learners_of(task).items()}
    planned = {*learners} & known.keys()
    planned |= {ablated for key in planned if (ablated := known[key].ablation_of)}
    trained = {name: learner for name, learner in reference.learners.items() if name in planned}
    for name in (name for name in learners if name not in planned):
        trained[names[name]] = Learner(overrides={"algorithm.name": name}) if ":" in name else Learner(config=name)
    study_tasks = {}
    for key, task in suite.load().tasks.items():
        given = reference.tasks.get(key, StudyTask(task=key))
        changed = {name: learner for name, learner in given.learners.items() if name in planned}
        tuning = given.tuning if planned else None
        own = {"learners": changed, "title": task.title, "tuning": tuning, "seeds": None}
        study_tasks[key] = given.model_copy(update=own)
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
