"""The reproduction of the paper, and its report: verdicts, tables and figures 4 to 10 of the paper."""

from __future__ import annotations

import tempfile
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator

from algorithms.reporting.curves import curve, limit_axis
from algorithms.reporting.page.plots import draw_front
from algorithms.reporting.style import ALGORITHM_COLOURS, figure_style, save_figure, surround
from algorithms.reporting.tables import markdown, print_rows
from algorithms.runs.config import CONFIGS
from algorithms.runs.interrupts import never_fatal
from algorithms.studies import FIGURES
from algorithms.studies.execution import Backend, Runner
from algorithms.studies.paper import (
    CLAIMS,
    FRONT_LEARNER,
    FRONT_TASK,
    LABELS,
    PaperResults,
    gather,
    paper_plan,
    percent,
    shown,
)
from algorithms.zoo.exporting import export
from mo_deepdrive.evaluation import metrics
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.metrics import HYPERVOLUME, STEP, STOCHASTIC, SUCCESS, UTILITY_ESR
from mo_deepdrive.evaluation.statistics import MIN_SAMPLES, iqm, iqm_difference, probability_of_improvement
from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray
    from rich.console import Console

    from algorithms.reporting.tables import Rows
    from algorithms.studies.paper import Claim, TaskResults
    from algorithms.studies.plan import ArmRuns
    from algorithms.studies.settings import Study

PUBLISHED = CONFIGS.parent / "docs" / "results"  # exists in a checkout alone
SOLVED, LEARNED = 0.95, 0.5  # success rates of a run that solves its task, and of one that does not fail
REPORT_FILE = "reproduction.md"
QUICK = "A quick reproduction checks the pipeline. It trains too little for verdicts."
EFFECT = ("difference from the first", "P(higher)")
COLLAPSED = 0.5  # a run of PCN has collapsed if its hypervolume is below this part of the median

# Figures of learning curves, a column per task (with a linear and a non-linear utility) and a row per protocol: their
# title, what tasks begin with, and their metric.
CURVE_FIGURES = {
    4: ("OneWaypoint", "one_waypoint", UTILITY_ESR),
    5: ("StaticObstacle", "static_obstacle", UTILITY_ESR),
    6: ("Intersection, both vehicles together", "intersection", metrics.TOTAL_UTILITY_ESR),
    8: ("Intersection, the vehicle that turns left (vehicle 0)", "intersection", f"vehicle_0/{UTILITY_ESR}"),
    9: ("Intersection, the vehicle that goes straight (vehicle 1)", "intersection", f"vehicle_1/{UTILITY_ESR}"),
}
# Drawn from a front by algorithms.reporting.page.plots, as the figure with this name.
FRONT_FIGURES = {7: "importance", 10: "reduction"}
PROTOCOLS = {"best": ", best effort", "printed": ", as printed"}  # by the end of a front's folder
LATE = 0.75  # share of the training after which a curve always gets the full height of its axis
MIN_WIDTH = 8.4  # inches, for the title and the note below it


def write_report(
    results: PaperResults, directory: Path, figures: Sequence[int], *, how: str, quick: bool = False
) -> list[Path]:
    """Write the results, the report, which quotes the command ``how``, and figures; the paths of the latter."""
    results.write(directory)
    pictures: dict[int, list[Path]] = {}
    for number in figures:
        path = directory / f"figure_{number:02}.png"
        draws_fronts = number in FRONT_FIGURES
        pictures[number] = _draw_fronts(number, path) if draws_fronts else _draw_curves(number, results, path)
    atomic_write(directory / REPORT_FILE, _document(results, pictures, how, quick).encode())
    return [directory / REPORT_FILE, *(path for paths in pictures.values() for path in paths)]


# ----------------------------------------------------------------------------------------------------------- figures


def _draw_curves(number: int, results: PaperResults, path: Path) -> list[Path]:
    """Draw a figure of learning curves into a path; returns it, or nothing if there are no results."""
    title, scenario, metric = CURVE_FIGURES[number]
    panels = {
        (protocol, task): of_task
        for task in (f"{scenario}_linear", f"{scenario}_nonlinear")
        for protocol, of_task in results.tasks.get(task, {}).items()
        if of_task.labels.keys() == LABELS.keys()
    }
    if not panels:
        return []
    protocols, tasks = (list(dict.fromkeys(place[i] for place in panels)) for i in (0, 1))
    with figure_style():
        figure = Figure(figsize=(max(4.7 * len(tasks), MIN_WIDTH), 2.9 * len(protocols)))
        axes = figure.subplots(len(protocols), len(tasks), squeeze=False)
        for row, protocol in zip(axes, protocols, strict=True):
            for axis, task in zip(row, tasks, strict=True):
                panel = panels.get((protocol, task))
                axis.set_visible(panel is not None)
                if panel is not None:
                    _draw_panel(axis, panel, metric)
        for axis in axes[-1]:
            axis.set_xlabel("environment steps")
        for axis in axes[:, 0]:
            axis.set_ylabel(metrics.title_of(UTILITY_ESR))
        seeds = sorted({len(panel.learning_curves(name)) for panel in panels.values() for name in LABELS})
        count = " to ".join(map(str, dict.fromkeys((seeds[0], seeds[-1]))))
        note = f"{STOCHASTIC} policy; thin: each of {count} seeds; thick: mean"
        enough = seeds[-1] >= MIN_SAMPLES
        note += " with 95% bootstrap interval" if enough else f", too few for an interval (n = {count})"
        final = "lines: the few scenarios of evaluations during training; "
        final += "diamonds: means of final scores, on the scenarios of the tables"
        names = {key: dict.fromkeys(_short(panel.labels[key]) for panel in panels.values()) for key in LABELS}
        handles = [
            Line2D([], [], color=ALGORITHM_COLOURS[key], linewidth=2.4, label=" or ".join(names[key])) for key in LABELS
        ]
        surround(figure, f"Figure {number}. {title}", [note, final], handles)
        save_figure(figure, path)
    return [path]


def _short(label: str) -> str:
    """The name in brackets of a label such as "A2C, clipped (PPO)", or else all of it."""
    return label.rpartition("(")[2].removesuffix(")")


def _draw_panel(axis: Axes, results: TaskResults, score: str) -> None:
    """Draw the mean over seeds with its interval, every seed as a thin line, and the mean of the final scores."""
    metric, drawn = f"{STOCHASTIC}/{score}", []
    for learner in LABELS:
        colour, runs = ALGORITHM_COLOURS[learner], results.learning_curves(learner)
        for run in (run for run in runs if metric in run):
            axis.plot(run[STEP], run[metric], color=colour, linewidth=0.6, alpha=0.45, zorder=2)
        averaged = curve(runs, metric)
        if averaged is None:
            continue
        steps, mean, low, high = averaged
        final = np.array([*results.by_seed(learner, score).values()])
        if len(final):
            (diamond,) = axis.plot(steps[-1], final.mean(), "D", color=colour, markersize=7, markeredgecolor="white")
            diamond.set(clip_on=False, zorder=5)
        settled = np.append(mean[steps >= LATE * steps.max()], final.mean() if len(final) else [])
        drawn.append((settled, mean, low, high, np.atleast_1d(final.mean()) if len(final) else mean))
        axis.plot(steps, mean, color=colour, linewidth=2.1, zorder=4)
        if np.isfinite(low).all():
            axis.fill_between(steps, low, high, color=colour, alpha=0.17, linewidth=0, zorder=3)
    cut = bool(drawn) and limit_axis(axis, metric, drawn)
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.yaxis.set_major_locator(MaxNLocator(6))
    axis.margins(x=0.015)
    utility, protocol = results.titles[0].rpartition(", ")[2].capitalize(), results.titles[1]
    names = " and ".join(_short(results.labels[learner]) for learner in LABELS)
    axis.set_title(f"{utility}: {names}{' (start cut off)' if cut else ''}\n{protocol}", fontsize=9.5)


def _draw_fronts(number: int, path: Path) -> list[Path]:
    """Draw a figure of every front beside a path; returns the files."""
    paths = []
    for folder in sorted(path.parent.glob("front_*/")):
        paths.append(path.with_stem(f"{path.stem}_{folder.name.removeprefix('front_')}"))
        with tempfile.TemporaryDirectory() as scratch:
            protocol = PROTOCOLS.get(paths[-1].stem.rpartition("_")[2], "")
            draw_front(Front.read(folder), scratch, title=f"Figure {number}. PCN on OneWaypoint{protocol}")
            atomic_write(paths[-1], (Path(scratch) / f"{FRONT_FIGURES[number]}.png").read_bytes())
    return paths


# ----------------------------------------------------------------------------------------------------------- tables


def claim_table(claim: Claim, results: PaperResults, *, quick: bool = False) -> Rows:
    """What decides a claim, and the verdicts: a row per criterion, a column per protocol."""
    answers = {True: "yes", False: "no", None: "inconclusive"}
    judged = claim.verdicts(results)
    rows = [["criterion", *(results.tasks[claim.tasks[0]][protocol].titles[1] for protocol in judged)]]
    for checks in zip(*(verdict.checks for verdict in judged.values()), strict=True):
        rows.append([checks[0].criterion, *(f"{answers[check.passed]}: {check.measured}" for check in checks)])
    return [*rows, ["verdict", *("not judged" if quick else verdict.text for verdict in judged.values())]]


def verdict_table(results: PaperResults, *, quick: bool = False) -> str:
    """The verdicts as Markdown: a row per claim and protocol."""
    rows = [["claim", "protocol", "verdict"]]
    for claim in CLAIMS:
        name = f"{claim.number}. {claim.statement}"
        protocols, *_, verdicts = claim_table(claim, results, quick=quick)
        for protocol, verdict in zip(protocols[1:], verdicts[1:], strict=True):
            rows.append([name, protocol, f"**{verdict}**"])
            name = ""
    return _table(rows, 2)


def print_verdicts(results: PaperResults, console: Console, *, quick: bool = False) -> None:
    """Print the verdicts: a table per claim."""
    for claim in CLAIMS:
        if claim.verdicts(results):
            print_rows(console, claim_table(claim, results, quick=quick), f"{claim.number}. {claim.statement}", 1)


def _task_section(protocols: Mapping[str, TaskResults]) -> str:
    """The title of a task, and its scores: a row per protocol and learner, the others compared with the first one."""
    rows: list[dict[str, str]] = []
    for results in protocols.values():
        scores = {learner: results.values(learner, results.score.metric) for learner in results.labels}
        first, *_ = scores.values()
        for learner, values in scores.items():
            protocol = results.titles[1] if values is first else ""
            row = {"protocol": protocol, "algorithm": results.labels[learner], "seeds": str(len(values))}
            row["steps"] = f"{results.steps:,}"
            if results.is_front:
                rows.append(row | _front_scores(results, values))
                continue
            effect = shown(iqm_difference(values, first)), probability_of_improvement(values, first).text()
            row |= _driving_scores(results, learner, values)
            rows.append(row | dict(zip(EFFECT, ("", "") if values is first else effect, strict=True)))
    table = _table([[*rows[0]], *([*row.values()] for row in rows)], 2)
    return f"{next(iter(protocols.values())).titles[0]}\n\n{table}"


def _driving_scores(results: TaskResults, learner: str, utilities: NDArray[np.float64]) -> dict[str, str]:
    distance = metrics.vehicle_prefix(0, results.vehicles) + metrics.return_of("distance")
    return {
        "utility (ESR)": shown(iqm(utilities)),
        "success rate": percent(iqm(results.values(learner, SUCCESS))),
        "collisions": percent(iqm(results.values(learner, metrics.end_by(metrics.COLLISION)))),
        "progress (m)": shown(iqm(results.values(learner, distance))),
    }


def _front_scores(results: TaskResults, volumes: NDArray[np.float64]) -> dict[str, str]:
    names = metrics.CARDINALITY, metrics.LOWEST_DISTANCE, metrics.HIGHEST_DISTANCE
    count, lowest, highest = (iqm(results.values(FRONT_LEARNER, name)) for name in names)
    return {
        "hypervolume": iqm(volumes).text(),
        "collapsed runs": f"{(volumes < COLLAPSED * np.median(volumes)).sum()} of {len(volumes)}",
        "non-dominated policies": count.text(),
        "progress of the policies (m)": f"{lowest.value:.2g} to {highest.value:.3g}",
    }


def _table(rows: Rows, labels: int) -> str:
    """A table of Markdown; in one of a single row, all labels would be what the rows share."""
    return markdown(rows, labels if len(rows) > 2 else 0, "").strip()


def _document(results: PaperResults, pictures: Mapping[int, Sequence[Path]], how: str, quick: bool) -> str:
    """The whole report as Markdown."""
    runs = results.scores.unique(["task", "learner", "seed"])
    parts = [
        "# Reproduction of the paper's figures and claims",
        f"Written by `{how}`: {len(runs)} runs, {runs['cpu_seconds'].sum() / 3600:.1f} hours on one core, seeds "
        f"{min(runs['seed'])} to {max(runs['seed'])}. Background: [reproduction](../reproduction.md).",
        "Scores are interquartile means over seeds of the utility (ESR) of the policy that samples its actions; at the "
        "intersection, of the sum of both vehicles' utilities. The scores of every run, also of greedy policies, are "
        "in reproduction_scores.csv.",
        "Intervals (95%, bootstrap) are over seeds. P(higher) is the probability that a run scores higher than one of "
        f"the first algorithm. A run of PCN has collapsed if its hypervolume is below {COLLAPSED:.0%} of the median.",
        *([f"**{QUICK}**"] if quick else []),
        "## Verdicts",
        verdict_table(results, quick=quick),
    ]
    unclaimed, drawn = dict(results.tasks), set[Path]()
    for claim in CLAIMS:
        unclaimed = {task: protocols for task, protocols in unclaimed.items() if task not in claim.tasks}
        if not claim.verdicts(results):
            continue
        parts += [f"## Claim {claim.number}", _table(claim_table(claim, results, quick=quick), 1)]
        parts += [f"### {_task_section(results.tasks[task])}" for task in claim.tasks]
        for number in claim.figures:
            new = [path for path in pictures.get(number, []) if path not in drawn]  # claims share figures
            parts += [f"![Figure {number}]({path.name})" for path in new]
            drawn |= {*new}
    parts += [f"## {_task_section(protocols)}" for protocols in unclaimed.values()]
    return "\n\n".join(parts) + "\n"


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
    chosen = [f"--{name} {value}" for name in ("figure", "claim", "seeds") if (value := getattr(options, name))]
    command = " ".join(["mo-deepdrive reproduce", *(["--quick"] if quick else [] if part else ["--all"]), *chosen])
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
        shown = (HYPERVOLUME, metrics.CARDINALITY) if of_task.is_front else (SUCCESS, metric)
        for zoo_name, seed, why in wanted:
            main_scores: dict[str, dict[str, float]] = {}
            for policy, score_name in product(metrics.POLICIES, shown):
                if (score := of_task.by_seed(learner, score_name, policy).get(seed)) is not None:
                    main_scores.setdefault(policy, {})[score_name] = score
            export(rows[seed].job(directory).open(), zoo_name, about={"chosen": why, "scores": main_scores})
            exported.append(zoo_name)
    return exported
