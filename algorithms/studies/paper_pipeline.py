"""The reproduction from start to finish: train missing runs, judge the claims, write report, figures and policies."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from algorithms.runs.accessories import sole_purpose
from algorithms.runs.shipped import CONFIGS
from algorithms.studies import FIGURES
from algorithms.studies.backends import Backend
from algorithms.studies.paper_claims import CLAIMS, FRONT_TASK, LEARNED, SOLVED, utility_metric
from algorithms.studies.paper_plan import Plan, PlannedRun, planned_runs
from algorithms.studies.paper_report import (
    QUICK,
    is_ablation,
    keep_fronts,
    median_run,
    print_verdicts,
    write_report,
)
from algorithms.studies.paper_results import ReproductionResults, gather
from algorithms.studies.runner import StudyRunner
from algorithms.zoo.exporting import export
from mo_deepdrive.evaluation.metrics import CARDINALITY, FRONT, HYPERVOLUME, STOCHASTIC, SUCCESS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

PUBLISHED = CONFIGS.parent / "docs" / "results"  # exists in a checkout alone


@dataclass(frozen=True)
class ReproductionOptions:
    """What to reproduce, and where to write it.

    Attributes:
        figure: number of the paper's figure to reproduce; None without such a restriction.
        claim: number of the paper's claim to reproduce; None without such a restriction.
        seeds: number of runs of each variant; None for the plan's.
        quick: whether to use fewer seeds and steps.
        redraw: whether to only judge and draw the results in ``output``, without training.
        runs: folder of the run directories; None for runs/reproduce or runs/reproduce-quick.
        output: folder of the report; None for a folder in ``runs``, in a checkout for docs/results if everything is
            reproduced.
        workers: maximum number of concurrent runs.
    """

    figure: int | None
    claim: int | None
    seeds: int | None
    quick: bool
    redraw: bool
    runs: Path | None
    output: Path | None
    workers: int

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

    def selection(self, plan: Plan) -> tuple[list[str], list[int]]:
        """The keys of the tasks, and the numbers of the figures, to reproduce."""
        if self.figure is not None:
            tasks = dict.fromkeys(task for claim in CLAIMS if self.figure in claim.figures for task in claim.tasks)
            return list(tasks), [self.figure]
        if self.claim is not None:
            claim = next(claim for claim in CLAIMS if claim.number == self.claim)
            return list(claim.tasks), list(claim.figures)
        return list(plan.tasks), list(FIGURES)


def reproduce(plan: Plan, options: ReproductionOptions, console: Console) -> int:
    """Train the runs that are missing, then write report and figures.

    A reproduction of everything with the plan's settings, in a checkout, also updates the zoo.

    Returns:
        The exit code: 0, 1 if runs failed, or 128 plus the number of the signal that interrupted the training.

    Raises:
        ValueError: for an invalid plan, missing results, or a run directory of another experiment.
        OSError: if something cannot be written.
        Stopped: if training cannot continue, for example because the disk is full.
    """
    tasks, figures = options.selection(plan)
    published = options.output_folder == PUBLISHED and options.output is None and options.seeds is None
    if options.redraw:
        results = ReproductionResults.read(options.output_folder)
        _write(plan, results, figures, options, console)
        return 0
    arms = plan.select(tasks, seeds=options.seeds, quick=options.quick)
    runs = planned_runs(arms, options.run_folder)
    code = StudyRunner(arms, options.run_folder, Backend(workers=options.workers), console).train()
    if code > 1:  # it was interrupted
        return code
    results = gather(runs, lambda line: print(line, file=sys.stderr))
    if not results.scores:
        raise ValueError("no run has finished and can be read")
    options.output_folder.mkdir(parents=True, exist_ok=True)
    keep_fronts(runs, results, options.output_folder)
    _write(plan, results, figures, options, console)
    if published and code == 0:
        names = export_policies(runs, plan, results)
        console.print(f"updated the policies {', '.join(names)} in the zoo")
    return code


def export_policies(runs: Sequence[PlannedRun], plan: Plan, results: ReproductionResults) -> list[str]:
    """Export a run of every compared variant to the zoo; returns the names there.

    It is the run with the median score. If that run fails (it arrives in under half of the episodes) and others solve
    the task, the run with the median score among those is exported too, under a name that ends in "-solved".
    """
    names: list[str] = []

    def export_run(run: PlannedRun, name: str, chosen: str) -> None:
        export(run.job.open(), name, about={"chosen": chosen, "scores": scores_of(run, results)})
        names.append(name)

    def success_rate(run: PlannedRun) -> float:
        return scores_of(run, results).get(STOCHASTIC, {}).get(SUCCESS, 1.0)  # a front has none

    for task, protocol, variant in dict.fromkeys((run.task, run.protocol, run.variant) for run in runs):
        if is_ablation(plan.tasks[task].protocols[protocol]):
            continue
        metric, policy = (HYPERVOLUME, FRONT) if task == FRONT_TASK else (utility_metric(task), STOCHASTIC)
        mine = [run for run in runs if (run.task, run.protocol, run.variant) == (task, protocol, variant)]
        chosen = median_run(mine, results, metric, policy)
        if chosen is not None:
            suffix = "" if protocol == "best" else f"-{protocol}"
            name = f"{task}-{chosen.job.experiment.algorithm.name}{suffix}"
            export_run(chosen, name, f"median {metric} of {len(mine)} seeds")
            solved = [run for run in mine if success_rate(run) > SOLVED]
            success = median_run(solved, results, metric, policy)
            if success is not None and success_rate(chosen) < LEARNED:
                seeds = f"the {len(solved)} of {len(mine)} seeds that arrive in over {SOLVED:.0%} of the episodes"
                export_run(success, f"{name}-solved", f"median {metric} of {seeds}")
    return names


def scores_of(run: PlannedRun, results: ReproductionResults) -> dict[str, dict[str, float]]:
    """The main scores of a run, by policy and metric: arrivals and utility, or those of a front."""
    metrics = (HYPERVOLUME, CARDINALITY) if run.task == FRONT_TASK else (SUCCESS, utility_metric(run.task))
    return {
        policy: {metric: row[metric] for metric in metrics if metric in row}
        for policy, row in results.of_run(run).items()
    }


def _write(
    plan: Plan, results: ReproductionResults, figures: Sequence[int], options: ReproductionOptions, console: Console
) -> None:
    """Write the report, and print the verdicts."""
    with sole_purpose("the report could not be written"):
        paths = write_report(plan, results, options.output_folder, figures, how=options.command, quick=options.quick)
    print_verdicts(plan, results, console, quick=options.quick)
    if options.quick:
        console.print(QUICK)
    console.print(f"written: {', '.join(str(path) for path in paths)}", soft_wrap=True)
