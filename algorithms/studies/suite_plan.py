"""The study that ``mo-deepdrive suite run`` makes, and the reference study and results of the suite."""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.runs.config import CONFIGS
from algorithms.studies import ALL, CORE, REFERENCE
from algorithms.studies.manifest import short_names
from algorithms.studies.plan import StudyPlan
from algorithms.studies.settings import (
    ELSEWHERE,
    Learner,
    StudyTask,
    key_problems,
    keys_in,
    load_study,
    problems_of,
)
from mo_deepdrive import suite

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

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
