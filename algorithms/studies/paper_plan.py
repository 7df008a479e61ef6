"""The plan of the reproduction: the study of the paper's tasks, and its runs.

The name of a task of this study is ``TASK/PROTOCOL``, its title "task: protocol". A protocol is how a task is trained
and evaluated; the learners of a protocol, here called variants, are compared with each other.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from algorithms.studies.plan import StudyPlan
from algorithms.studies.settings import load_study
from mo_deepdrive.support.names import nearest

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from algorithms.runs.jobs import Job
    from algorithms.studies.settings import Study

STUDY = "studies/paper"
# Environment steps of a quick reproduction by protocol; other protocols are left out.
QUICK_STEPS = {"printed": 100_000, "best": 600_000}
QUICK_STEPS_OF_TASKS = {
    "one_waypoint_front": {"printed": 20_000, "best": 40_000},
    "intersection_linear": {"printed": 50_000, "best": 300_000},
    "intersection_nonlinear": {"printed": 50_000, "best": 300_000},
    "one_waypoint_continuous": {},
}
QUICK_SEEDS, QUICK_EPISODES = 3, 200
QUICK_EVALUATIONS = 5  # during training


@dataclass(frozen=True)
class Protocol:
    """Variants that are trained under the same conditions; their labels by key."""

    title: str
    variants: dict[str, str]


@dataclass(frozen=True)
class PlannedTask:
    """One scenario under one utility, or with an unknown utility, and its protocols by key."""

    title: str
    protocols: dict[str, Protocol] = field(default_factory=dict)


@dataclass(frozen=True)
class PlannedRun:
    """A run of the plan.

    Attributes:
        task, protocol, variant: their keys.
        label: of the variant.
        seed: of the run.
        job: trains the run.
    """

    task: str
    protocol: str
    variant: str
    label: str
    seed: int
    job: Job


class Plan:
    """The whole reproduction.

    Args:
        study: of the paper.

    Attributes:
        study: of the paper.
        tasks: by key.

    Raises:
        ValueError: if the name or the title of a task is not of the form that this module describes.
    """

    def __init__(self, study: Study):
        self.study = study
        self.tasks: dict[str, PlannedTask] = {}
        for key, each in study.tasks.items():
            task, slash, protocol = key.partition("/")
            title, colon, conditions = (each.title or "").partition(": ")
            if not slash or not colon:
                raise ValueError(f"task {key!r} must be named TASK/PROTOCOL, with a title 'task: protocol'")
            labels = {name: learner.label or name for name, learner in study.learners_of(key).items()}
            self.tasks.setdefault(task, PlannedTask(title)).protocols[protocol] = Protocol(conditions, labels)

    def select(self, tasks: Sequence[str], *, seeds: int | None = None, quick: bool = False) -> StudyPlan:
        """The arms to train for some tasks; every experiment of them is resolved and checked.

        Args:
            tasks: keys of the tasks.
            seeds: number of runs of each variant, instead of the plan's; a task that names its seeds has at most these.
            quick: fewer seeds and steps, without protocols that have no quick form.

        Raises:
            ValueError: for an unknown task, or naming the arm that is not valid.
        """
        for key in tasks:
            if key not in self.tasks:
                raise ValueError(f"task {key!r} is unknown; {nearest(key, self.tasks)}")
        first, count = self.study.seeds[0], seeds or len(self.study.seeds[: QUICK_SEEDS if quick else None])
        of_tasks = {}
        for key, each in self.study.tasks.items():
            mine = each.seeds if each.seeds is not None else list(range(first, first + count))
            changes: dict[str, Any] = {"seeds": mine if seeds is None and not quick else mine[:count]}
            if quick and (steps := _quick_steps(key)) is not None:
                interval = {"evaluation.interval": steps // QUICK_EVALUATIONS}
                shorter = {**each.overrides, **interval, "evaluation.final_episodes": QUICK_EPISODES}
                changes |= {"steps": steps, "overrides": shorter}
            if not quick or "steps" in changes:
                of_tasks[key] = each.model_copy(update=changes)
        study = self.study.model_copy(update={"tasks": of_tasks})
        return StudyPlan(study, [key for key in of_tasks if key.partition("/")[0] in tasks])


def _quick_steps(key: str) -> int | None:
    """Environment steps of a task of the study in a quick reproduction; None to leave it out."""
    task, _, protocol = key.partition("/")
    return QUICK_STEPS_OF_TASKS.get(task, QUICK_STEPS).get(protocol)


def load_plan(path: str | Path) -> Plan:
    """Read a plan: the YAML file of a study, or the name of a shipped one.

    Raises:
        ValueError: naming the file and every invalid key.
    """
    return Plan(load_study(path))


def planned_runs(arms: StudyPlan, folder: Path) -> list[PlannedRun]:
    """The runs of the arms that were selected, which are in ``folder``.

    Raises:
        ValueError: naming the task, protocol and variant with an invalid config.
    """
    runs = []
    for each in arms.runs({}):
        if each.arm.key in arms.selected:
            task, _, protocol = each.arm.task.partition("/")
            about = (task, protocol, each.arm.learner, each.arm.label)
            runs += [PlannedRun(*about, row.seed, row.job(folder)) for row in each.final]
    return runs
