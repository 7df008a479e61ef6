"""The reproduction of the paper: a study of its tasks, whose results are judged, drawn and exported.

The name of a task of this study is ``TASK/PROTOCOL``, its title "task: protocol". A protocol is how a task is trained
and evaluated; the learners of a protocol are compared with each other.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from algorithms.runs.config import CONFIGS
from algorithms.runs.interrupts import never_fatal
from algorithms.studies import FIGURES
from algorithms.studies.collection import collect
from algorithms.studies.execution import Backend, Runner
from algorithms.studies.paper_claims import CLAIMS, FRONT_LEARNER, FRONT_TASK, PaperResults
from algorithms.studies.paper_report import QUICK, print_verdicts, write_report
from algorithms.studies.plan import StudyPlan
from algorithms.studies.results import results_of
from algorithms.studies.settings import load_study
from algorithms.zoo.exporting import export
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.metrics import (
    CARDINALITY,
    COLLISION,
    EVALUATION,
    HIGHEST_DISTANCE,
    HYPERVOLUME,
    LOWEST_DISTANCE,
    POLICIES,
    STEP,
    SUCCESS,
    TOTAL_UTILITY_ESR,
    end_by,
    return_of,
    vehicle_prefix,
)
from mo_deepdrive.support.names import nearest

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from algorithms.studies.plan import ArmRuns
    from algorithms.studies.settings import Study

PUBLISHED = CONFIGS.parent / "docs" / "results"  # exists in a checkout alone
# A quick reproduction: protocols, seeds, share of the steps, final episodes, and evaluations during training.
QUICK_PROTOCOLS, QUICK_SEEDS, QUICK_SHARE, QUICK_EPISODES, QUICK_EVALUATIONS = ("printed", "best"), 3, 10, 200, 5
SOLVED, LEARNED = 0.95, 0.5  # success rates of a run that solves its task, and of one that does not fail


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
    """The arms to train for some tasks, in all their protocols, or quick ones, with so many ``seeds`` at most."""
    known = {key.partition("/")[0] for key in study.tasks}
    for name in (name for name in tasks if name not in known):
        raise ValueError(f"task {name!r} is unknown; {nearest(name, known)}")
    selected = [key for key in study.tasks if key.partition("/")[0] in tasks]
    if quick:
        selected = [key for key in selected if key.partition("/")[2] in QUICK_PROTOCOLS]
    if count := seeds or (min(QUICK_SEEDS, len(study.seeds)) if quick else None):
        first, tasks_of_fewer = study.seeds[0], {}
        for key, task in study.tasks.items():
            tasks_of_fewer[key] = task.model_copy(update={"seeds": task.seeds and task.seeds[:count]})
        study = study.model_copy(update={"tasks": tasks_of_fewer, "seeds": list(range(first, first + count))})
    plan = StudyPlan(study, selected)
    for arm in plan.arms if quick else ():
        steps = arm.values["training"]["total_timesteps"] // QUICK_SHARE
        arm.values["training"]["total_timesteps"] = steps
        shorter = {"interval": steps // QUICK_EVALUATIONS, "final_episodes": QUICK_EPISODES}
        arm.values["evaluation"] = {**(arm.values.get("evaluation") or {}), **shorter}
    return plan


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
    collection = collect(directory, lambda line: print(line, file=sys.stderr))
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


def reproduce(study: Study, options: Namespace, console: Console) -> int:
    """Train the missing runs, write report and figures, update the zoo of a checkout; the code of Runner.run.

    The options are those of ``mo-deepdrive reproduce``, which describes them.
    """
    figure, claim, seeds, quick = options.figure, options.claim, options.seeds, options.quick
    tasks, figures = list(dict.fromkeys(key.partition("/")[0] for key in study.tasks)), list(FIGURES)
    if figure or claim:
        claims = [known for known in CLAIMS if figure in known.figures or known.number == claim]
        tasks = list(dict.fromkeys(task for known in claims for task in known.tasks))
        figures = [figure] if figure else claims[0].figures
    runs = options.runs or Path("runs") / ("reproduce-quick" if quick else "reproduce")
    part = figure or claim or quick
    # A report of everything with all steps is published where there is a checkout.
    output = options.output or (runs / "results" if part or not PUBLISHED.is_dir() else PUBLISHED)
    given = [f"--{name} {value}" for name in ("figure", "claim", "seeds") if (value := getattr(options, name))]
    command = " ".join(["mo-deepdrive reproduce", *(["--quick"] if quick else [] if part else ["--all"]), *given])
    code, arms, results = 0, [], None
    if options.redraw:
        results = PaperResults.read(study, output)
    else:
        plan = paper_plan(study, tasks, seeds=seeds, quick=quick)
        runner = Runner(plan, runs, Backend(workers=options.workers), console)
        code = runner.run()
        if code > 1:  # it was interrupted
            return code
        arms = [arm for arm in plan.runs(runner) if arm.arm.key in plan.selected]
        results = gather(plan, arms, runs)
        if not results.tasks:
            raise ValueError("no run has finished")
        output.mkdir(parents=True, exist_ok=True)
        _keep_fronts(arms, results, runs, output)
    paths: list[Path] = []
    with never_fatal("the report could not be written"):
        paths = write_report(results, output, figures, how=command, quick=quick)
    print_verdicts(results, console, quick=quick)
    if quick:
        console.print(QUICK)
    console.print(f"written: {', '.join(map(str, paths))}", soft_wrap=True)
    if arms and output == PUBLISHED and not options.output and not seeds and code == 0:
        console.print(f"updated the policies {', '.join(export_policies(arms, results, runs))} in the zoo")
    return code


def _median_seed(scores: Mapping[int, float]) -> int | None:
    """The seed with the median of the scores by seed, the lower of two; None if there are none."""
    ordered = sorted(scores, key=lambda seed: (scores[seed], seed))
    return ordered[(len(ordered) - 1) // 2] if ordered else None


def _keep_fronts(runs: Sequence[ArmRuns], results: PaperResults, directory: Path, output: Path) -> None:
    """Save the front of the run with the median hypervolume of every protocol; figures are drawn from it."""
    rows = {(arm.arm.task, row.seed): row for arm in runs for row in arm.final}
    for protocol, of_protocol in results.tasks.get(FRONT_TASK, {}).items():
        seed = _median_seed(of_protocol.by_seed(FRONT_LEARNER, HYPERVOLUME))
        if seed is not None:
            folder = output / f"front_{protocol}"
            folder.mkdir(exist_ok=True)
            Front.read(directory / rows[of_protocol.key, seed].directory).write(folder, {"seed_of_the_run": seed})


def export_policies(runs: Sequence[ArmRuns], results: PaperResults, directory: Path) -> list[str]:
    """Export the run with the median score of every compared learner; the names in the zoo.

    If it fails while others solve the task, the median one of those is exported, too, as "NAME-solved".
    """
    exported: list[str] = []
    for arm in runs:
        task, _, protocol = arm.arm.task.partition("/")
        of_task, learner = results.tasks.get(task, {}).get(protocol), arm.arm.learner
        if of_task is None or learner not in of_task.compared:
            continue
        metric = of_task.score.metric
        scores = of_task.by_seed(learner, metric)
        chosen = _median_seed(scores)
        if chosen is None:
            continue
        rows = {row.seed: row for row in arm.final}
        name = f"{task}-{rows[chosen].config['algorithm']['name']}" + ("" if protocol == "best" else f"-{protocol}")
        wanted = [(name, chosen, f"median {metric} of {len(arm.arm.seeds)} seeds")]
        arrivals = {} if of_task.is_front else of_task.by_seed(learner, SUCCESS)
        solved = {seed: scores[seed] for seed, rate in arrivals.items() if rate > SOLVED}
        success = _median_seed(solved)
        if success is not None and arrivals[chosen] < LEARNED:
            seeds = f"{len(solved)} of {len(arm.arm.seeds)} seeds that arrive in over {SOLVED:.0%} of the episodes"
            wanted.append((f"{name}-solved", success, f"median {metric} of the {seeds}"))
        shown = (HYPERVOLUME, CARDINALITY) if of_task.is_front else (SUCCESS, metric)
        for zoo_name, seed, why in wanted:
            main_scores: dict[str, dict[str, float]] = {}
            for policy, metric in product(POLICIES, shown):
                if (score := of_task.by_seed(learner, metric, policy).get(seed)) is not None:
                    main_scores.setdefault(policy, {})[metric] = score
            export(rows[seed].job(directory).open(), zoo_name, about={"chosen": why, "scores": main_scores})
            exported.append(zoo_name)
    return exported
