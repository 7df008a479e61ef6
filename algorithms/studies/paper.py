"""The reproduction of the paper: a study of its tasks, whose results are judged, drawn and exported.

The name of a task of this study is ``TASK/PROTOCOL``, its title "task: protocol". A protocol is how a task is trained
and evaluated; the learners of a protocol are compared with each other.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import polars as pl

from algorithms.runs.config import CONFIGS
from algorithms.runs.interrupts import sole_purpose
from algorithms.studies import FIGURES
from algorithms.studies.backends import Backend
from algorithms.studies.collection import collect
from algorithms.studies.manifest import overridden
from algorithms.studies.paper_claims import (
    CLAIMS,
    FRONT_TASK,
    LEARNED,
    SOLVED,
    is_ablation,
    utility_metric,
)
from algorithms.studies.paper_report import QUICK, print_verdicts, write_report
from algorithms.studies.paper_results import PaperResults
from algorithms.studies.plan import StudyPlan
from algorithms.studies.results import results_of
from algorithms.studies.runner import StudyRunner
from algorithms.studies.settings import load_study
from algorithms.zoo.exporting import export
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.metrics import (
    CARDINALITY,
    COLLISION,
    EVALUATION,
    FRONT,
    HIGHEST_DISTANCE,
    HYPERVOLUME,
    LOWEST_DISTANCE,
    POLICIES,
    STEP,
    STOCHASTIC,
    SUCCESS,
    TOTAL_UTILITY_ESR,
    end_by,
    return_of,
    vehicle_prefix,
)
from mo_deepdrive.support.names import nearest

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from algorithms.studies.plan import Arm, ArmRuns
    from algorithms.studies.settings import Study

PUBLISHED = CONFIGS.parent / "docs" / "results"  # exists in a checkout alone
# A quick reproduction: protocols, seeds, share of the steps, final episodes, and evaluations during training.
QUICK_PROTOCOLS, QUICK_SEEDS, QUICK_SHARE, QUICK_EPISODES, QUICK_EVALUATIONS = ("printed", "best"), 3, 10, 200, 5


# -------------------------------------------------------------------------------------------------------------- plan


def load_paper(path: str | Path) -> Study:
    """Read the study of the paper: a YAML file, or the name of a shipped one."""
    study = load_study(path)
    for key, task in study.tasks.items():
        if "/" not in key or ": " not in (task.title or ""):
            raise ValueError(f"task {key!r} must be named TASK/PROTOCOL, with a title 'task: protocol'")
        needed = {SUCCESS, end_by(COLLISION), return_of("distance")}
        if key.startswith("intersection"):
            needed |= {TOTAL_UTILITY_ESR, vehicle_prefix(0, 2) + return_of("distance")}
        elif key.startswith(FRONT_TASK):
            needed = {CARDINALITY}
        if missing := needed - {*study.columns}:
            raise ValueError(f"task {key!r}: the report needs the columns {', '.join(sorted(missing))}")
    return study


def paper_plan(study: Study, tasks: Sequence[str], *, seeds: int | None = None, quick: bool = False) -> StudyPlan:
    """The arms to train for some tasks.

    Args:
        study: of the paper.
        tasks: without their protocols, all of which are selected.
        seeds: number of runs of each learner, instead of the study's; a task that names its seeds has at most these.
        quick: fewer seeds and steps, of the protocols that claims are judged by.
    """
    known = {key.partition("/")[0] for key in study.tasks}
    for task in tasks:
        if task not in known:
            raise ValueError(f"task {task!r} is unknown; {nearest(task, known)}")
    selected = [key for key in study.tasks if key.partition("/")[0] in tasks]
    if quick:
        selected = [key for key in selected if key.partition("/")[2] in QUICK_PROTOCOLS]
    if count := seeds or (min(QUICK_SEEDS, len(study.seeds)) if quick else None):
        fewer = {
            key: task.model_copy(update={"seeds": task.seeds and task.seeds[:count]})
            for key, task in study.tasks.items()
        }
        first = study.seeds[0]
        study = study.model_copy(update={"tasks": fewer, "seeds": list(range(first, first + count))})
    plan = StudyPlan(study, selected)
    if quick:
        plan.arms = tuple(map(_shortened, plan.arms))
    return plan


def _shortened(arm: Arm) -> Arm:
    """An arm of a quick reproduction."""
    steps = arm.values["training"]["total_timesteps"] // QUICK_SHARE
    changes = {
        "training.total_timesteps": steps,
        "evaluation.interval": steps // QUICK_EVALUATIONS,
        "evaluation.final_episodes": QUICK_EPISODES,
    }
    return replace(arm, values=overridden(arm.values, changes, {}))


# ----------------------------------------------------------------------------------------------------------- results


def gather(plan: StudyPlan, runs: Sequence[ArmRuns], directory: Path) -> PaperResults:
    """The results of all runs that have finished in the directory of the study."""
    rows = results_of(plan, runs, directory)
    for row in [row for row in rows if row.column == HYPERVOLUME]:
        front = Front.read(directory / row.source)
        if "distance" in front.objectives:
            distances = front.returns[:, front.objectives.index("distance")]
            for column, value in ((LOWEST_DISTANCE, distances.min()), (HIGHEST_DISTANCE, distances.max())):
                rows.append(replace(row, column=column, value=float(value), low=None, high=None))
    collection = collect(directory)
    collection.report_problems(lambda line: print(line, file=sys.stderr))
    keys = pl.DataFrame(
        [(row.id, *arm.arm.key, row.seed) for arm in runs for row in arm.final],
        {"run": pl.String, "task": pl.String, "learner": pl.String, "seed": pl.Int64},
        orient="row",
    )
    logged = collection.metrics.lazy()
    names = [name for name in logged.collect_schema().names() if name.startswith(EVALUATION)]
    metrics = (pl.col(name).cast(pl.Float32).alias(name.removeprefix(EVALUATION)) for name in names)
    evaluated = logged.filter(pl.any_horizontal(pl.col(names).is_not_null())).select("run", STEP, *metrics).collect()
    curves = keys.join(evaluated, on="run", maintain_order="left_right").drop("run")
    return PaperResults(plan.study, rows, curves)


# ------------------------------------------------------------------------------------------------------ reproduction


@dataclass(frozen=True)
class Reproduction:
    """What to reproduce, and where to write it: the options of ``mo-deepdrive reproduce``, which describes them."""

    study: Study
    figure: int | None = None
    claim: int | None = None
    seeds: int | None = None
    quick: bool = False
    redraw: bool = False
    runs: Path | None = None
    output: Path | None = None
    workers: int | None = None

    @property
    def everything(self) -> bool:
        """Whether all figures and claims are reproduced."""
        return self.figure is None and self.claim is None

    @property
    def run_folder(self) -> Path:
        """The folder of the run directories."""
        return self.runs or Path("runs") / ("reproduce-quick" if self.quick else "reproduce")

    @property
    def output_folder(self) -> Path:
        """The folder of the report."""
        publish = self.everything and not self.quick and PUBLISHED.is_dir()
        return self.output or (PUBLISHED if publish else self.run_folder / "results")

    @property
    def command(self) -> str:
        """The command that creates the same report."""
        given = [f"--{name} {value}" for name in ("figure", "claim", "seeds") if (value := getattr(self, name))]
        quick = ["--quick"] if self.quick else []
        everything = ["--all"] if self.everything and not self.quick else []
        return " ".join(["mo-deepdrive reproduce", *everything, *quick, *given])

    def selection(self) -> tuple[list[str], list[int]]:
        """The tasks, without their protocols, and the numbers of the figures to reproduce."""
        if self.figure is not None:
            tasks = dict.fromkeys(task for claim in CLAIMS if self.figure in claim.figures for task in claim.tasks)
            return list(tasks), [self.figure]
        if self.claim is not None:
            claim = next(claim for claim in CLAIMS if claim.number == self.claim)
            return list(claim.tasks), list(claim.figures)
        return list(dict.fromkeys(key.partition("/")[0] for key in self.study.tasks)), list(FIGURES)

    def run(self, console: Console) -> int:
        """Train the runs that are missing, then write report and figures.

        A reproduction of everything with the study's settings, in a checkout, also updates the zoo.

        Returns:
            The exit code: 0, 1 if runs failed, or 128 plus the number of the signal that interrupted the training.

        Raises:
            ValueError: for an invalid study, missing results, or a directory of another study.
            OSError: if something cannot be written.
            Stopped: if training cannot continue, for example because the disk is full.
        """
        tasks, figures = self.selection()
        if self.redraw:
            self._write(PaperResults.read(self.study, self.output_folder), figures, console)
            return 0
        plan = paper_plan(self.study, tasks, seeds=self.seeds, quick=self.quick)
        runner = StudyRunner(plan, self.run_folder, Backend(workers=self.workers), console)
        code = runner.train()
        if code > 1:  # it was interrupted
            return code
        runs = [arm for arm in runner.runs_of_arms() if arm.arm.key in plan.selected]
        results = gather(plan, runs, self.run_folder)
        if all(row.value is None for row in results.rows):
            raise ValueError("no run has finished")
        self.output_folder.mkdir(parents=True, exist_ok=True)
        keep_fronts(runs, results, self.run_folder, self.output_folder)
        self._write(results, figures, console)
        if self.output_folder == PUBLISHED and self.output is None and self.seeds is None and code == 0:
            names = export_policies(runs, results, self.run_folder)
            console.print(f"updated the policies {', '.join(names)} in the zoo")
        return code

    def _write(self, results: PaperResults, figures: Sequence[int], console: Console) -> None:
        """Write the report, and print the verdicts."""
        with sole_purpose("the report could not be written"):
            paths = write_report(results, self.output_folder, figures, how=self.command, quick=self.quick)
        print_verdicts(results, console, quick=self.quick)
        if self.quick:
            console.print(QUICK)
        console.print(f"written: {', '.join(str(path) for path in paths)}", soft_wrap=True)


def median_seed(scores: Mapping[int, float]) -> int | None:
    """The seed with the median of the scores by seed, the lower of two; None if there are none."""
    ordered = sorted(scores, key=lambda seed: (scores[seed], seed))
    return ordered[(len(ordered) - 1) // 2] if ordered else None


def keep_fronts(runs: Sequence[ArmRuns], results: PaperResults, directory: Path, output: Path) -> None:
    """Save the front of the run with the median hypervolume of every protocol; figures are drawn from it."""
    for arm in runs:
        task, _, protocol = arm.arm.task.partition("/")
        chosen = median_seed(results.by_seed(*arm.arm.key, HYPERVOLUME, FRONT)) if task == FRONT_TASK else None
        if chosen is not None:
            folder = output / f"front_{protocol}"
            folder.mkdir(exist_ok=True)
            row = next(row for row in arm.final if row.seed == chosen)
            Front.read(directory / row.directory).write(folder, {"seed_of_the_run": chosen})


def export_policies(runs: Sequence[ArmRuns], results: PaperResults, directory: Path) -> list[str]:
    """Export a run of every compared learner to the zoo; returns the names there.

    It is the run with the median score. If that run fails (it arrives in under half of the episodes) and others solve
    the task, the run with the median score among those is exported too, under a name that ends in "-solved".
    """
    exported: list[str] = []
    for arm in runs:
        task, _, protocol = arm.arm.task.partition("/")
        front = task == FRONT_TASK
        metric, policy = (HYPERVOLUME, FRONT) if front else (utility_metric(task), STOCHASTIC)
        scores = results.by_seed(*arm.arm.key, metric, policy)
        chosen = median_seed(scores)
        if chosen is None or is_ablation(results.study, arm.arm.task):
            continue
        rows = {row.seed: row for row in arm.final}
        name = f"{task}-{rows[chosen].config['algorithm']['name']}" + ("" if protocol == "best" else f"-{protocol}")
        wanted = [(name, chosen, f"median {metric} of {len(arm.arm.seeds)} seeds")]
        arrivals = {} if front else results.by_seed(*arm.arm.key, SUCCESS, STOCHASTIC)
        solved = {seed: scores[seed] for seed, rate in arrivals.items() if rate > SOLVED}
        success = median_seed(solved)
        if success is not None and arrivals[chosen] < LEARNED:
            seeds = f"{len(solved)} of {len(arm.arm.seeds)} seeds that arrive in over {SOLVED:.0%} of the episodes"
            wanted.append((f"{name}-solved", success, f"median {metric} of the {seeds}"))
        shown = (HYPERVOLUME, CARDINALITY) if front else (SUCCESS, metric)
        for zoo_name, seed, why in wanted:
            by_policy = {policy: _scores_of(results, arm, seed, policy, shown) for policy in POLICIES}
            about: dict[str, Any] = {"chosen": why, "scores": {key: each for key, each in by_policy.items() if each}}
            export(rows[seed].job(directory).open(), zoo_name, about=about)
            exported.append(zoo_name)
    return exported


def _scores_of(results: PaperResults, arm: ArmRuns, seed: int, policy: str, metrics: Sequence[str]) -> dict[str, float]:
    """The main scores of a run, by metric."""
    by_metric = {metric: results.by_seed(*arm.arm.key, metric, policy) for metric in metrics}
    return {metric: by_seed[seed] for metric, by_seed in by_metric.items() if seed in by_seed}
