"""The report of the reproduction: verdicts and tables as Markdown, figures, and fronts."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Column, Table
from rich.text import Text

from algorithms.reporting.explorer.plots import draw_front
from algorithms.studies.paper_claims import (
    BASELINE,
    CLAIMS,
    FRONT_TASK,
    FRONT_VARIANT,
    MULTI_OBJECTIVE,
    Claim,
    Verdict,
    compare,
    percent,
    utility_kind,
    utility_metric,
)
from algorithms.studies.paper_figures import CURVE_FIGURES, FRONT_FIGURES, draw_curves, file_name
from algorithms.studies.paper_results import ReproductionResults
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.metrics import (
    CARDINALITY,
    COLLISION,
    FRONT,
    HIGHEST_DISTANCE,
    HYPERVOLUME,
    LOWEST_DISTANCE,
    STOCHASTIC,
    SUCCESS,
    end_by,
    return_of,
    vehicle_prefix,
)
from mo_deepdrive.evaluation.statistics import iqm, iqm_difference, probability_of_improvement
from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from algorithms.studies.paper_plan import Plan, PlannedRun, Protocol

REPORT_FILE = "reproduction.md"
QUICK = "A quick reproduction checks the pipeline. It trains too little for verdicts."
VERDICT_COLUMNS = ("protocol", "A2C", "MO-A2C", "difference", "P(MO-A2C higher)", "verdict")
COLLAPSED = 0.5  # a run of PCN has collapsed if its hypervolume is below this part of the median


def write_report(
    plan: Plan,
    results: ReproductionResults,
    directory: Path,
    figures: Sequence[int],
    *,
    how: str,
    quick: bool = False,
) -> list[Path]:
    """Write the results, the report and the figures.

    Args:
        plan: of the reproduction.
        results: of its runs.
        directory: where to write.
        figures: numbers of the paper's figures to draw; those of fronts are drawn from the fronts in ``directory``.
        how: the command that creates the same report, which the report quotes.
        quick: whether the runs are too short for verdicts.

    Returns:
        The paths of the report and the figures.

    Raises:
        OSError: if a file cannot be written; no file is left half written.
    """
    results.write(directory)
    figure_paths: dict[int, list[Path]] = {}
    for figure in figures:
        if figure in CURVE_FIGURES:
            path = directory / file_name(figure)
            figure_paths[figure] = [path] if draw_curves(figure, plan, results, path) else []
        else:
            figure_paths[figure] = _draw_front_figure(figure, directory)
    text = _document(plan, results, figure_paths, how, quick)
    atomic_write(directory / REPORT_FILE, text.encode())
    return [directory / REPORT_FILE, *(path for paths in figure_paths.values() for path in paths)]


# ------------------------------------------------------------------------------------------------------------ fronts


def median_run(runs: Sequence[PlannedRun], results: ReproductionResults, metric: str, policy: str) -> PlannedRun | None:
    """The finished run with the median score, the lower of two; None if no run has finished."""
    scored = []
    for run in runs:
        score = results.of_run(run).get(policy, {}).get(metric)
        if score is not None:
            scored.append((score, run.seed, run))
    if not scored:
        return None
    scored.sort(key=lambda each: each[:2])
    return scored[(len(scored) - 1) // 2][2]


def keep_fronts(runs: Sequence[PlannedRun], results: ReproductionResults, directory: Path) -> None:
    """Save the front of the run with the median hypervolume of every protocol; figures are drawn from it."""
    for protocol in results.protocols(FRONT_TASK):
        mine = [run for run in runs if (run.task, run.protocol) == (FRONT_TASK, protocol)]
        chosen = median_run(mine, results, HYPERVOLUME, FRONT)
        if chosen is not None:
            folder = directory / f"front_{protocol}"
            folder.mkdir(exist_ok=True)
            Front.read(chosen.job.path).write(folder, {"seed_of_the_run": chosen.seed})


def _draw_front_figure(figure: int, directory: Path) -> list[Path]:
    """Draw a figure of every front in a directory; returns the files."""
    paths = []
    for folder in sorted(directory.glob("front_*")):
        if not folder.is_dir():
            continue
        protocol = folder.name.removeprefix("front_")
        path = directory / file_name(figure).replace(".png", f"_{protocol}.png")
        with tempfile.TemporaryDirectory() as scratch:
            draw_front(Front.read(folder), scratch, title=f"Figure {figure}. PCN on OneWaypoint")
            atomic_write(path, (Path(scratch) / f"{FRONT_FIGURES[figure]}.png").read_bytes())
        paths.append(path)
    return paths


# ------------------------------------------------------------------------------------------------------------ tables


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first row is the header."""
    header, *body = rows
    lines = [header, ["---"] * len(header), *body]
    return "\n".join("| " + " | ".join(cell.replace("|", "/") for cell in line) + " |" for line in lines)


def verdict_table(plan: Plan, results: ReproductionResults, *, quick: bool = False) -> str:
    """The verdicts as Markdown: a row per claim, protocol and task, with scores and effect size.

    Args:
        plan: of the reproduction.
        results: of its runs.
        quick: whether the runs are too short for verdicts; they are then not judged.
    """
    rows = [["claim", *VERDICT_COLUMNS]]
    for claim in CLAIMS:
        for i, (*row, conclusion) in enumerate(_verdict_rows(claim, plan, results, quick=quick)):
            name = f"{claim.number}. {claim.statement}" if i == 0 else ""
            bold = f"**{conclusion}**" if conclusion and not quick else conclusion
            rows.append([name, *row, bold])
    return markdown_table(rows)


def print_verdicts(plan: Plan, results: ReproductionResults, console: Console, *, quick: bool = False) -> None:
    """Print the verdicts: a table per claim; arguments as of :func:`verdict_table`."""
    for claim in CLAIMS:
        rows = _verdict_rows(claim, plan, results, quick=quick)
        if rows:
            table = Table(*(Column(name, overflow="fold") for name in VERDICT_COLUMNS), box=SIMPLE_HEAD)
            for row in rows:
                table.add_row(*(Text(cell.replace(" [", "\n[")) for cell in row))  # intervals below their values
            console.print(Text(f"{claim.number}. {claim.statement}", style="bold"), table)


def _verdict_rows(claim: Claim, plan: Plan, results: ReproductionResults, *, quick: bool) -> list[list[str]]:
    """The rows of a claim in :data:`VERDICT_COLUMNS`; of the tasks of a protocol, only the first has the verdict."""
    rows = []
    for protocol, verdict in verdicts(claim, results).items():
        title = plan.tasks[claim.tasks[0]].protocols[protocol].title
        for i, task in enumerate(claim.tasks):
            which = f" ({utility_kind(task)})" if len(claim.tasks) > 1 else ""
            conclusion = "" if i > 0 else "not judged" if quick else verdict.text
            rows.append([title + which, *_effect_columns(results, task, protocol), conclusion])
    return rows


def _effect_columns(results: ReproductionResults, task: str, protocol: str) -> list[str]:
    """The scores of both algorithms and their comparison; for a front, its number of policies."""
    if task == FRONT_TASK:
        count = iqm(results.values(task, protocol, FRONT_VARIANT, CARDINALITY, FRONT))
        return ["", "", f"PCN: {count.text()} non-dominated policies", ""]
    found = compare(results, task, protocol, utility_metric(task))
    utilities = [each.text(found.width) for each in (found.baseline, found.multi_objective, found.difference)]
    return [*utilities, found.improvement.text()]


def verdicts(claim: Claim, results: ReproductionResults) -> dict[str, Verdict]:
    """The verdicts of a claim, by protocol; only protocols with results for all tasks of the claim."""
    found = {}
    for protocol in results.protocols(claim.tasks[0]):
        verdict = claim.judge(results, protocol)
        if verdict is not None:
            found[protocol] = verdict
    return found


def _check_table(plan: Plan, claim: Claim, results: ReproductionResults) -> str:
    """The checks of a claim: a row per criterion, a column per protocol."""
    answers = {True: "yes", False: "no", None: "inconclusive"}
    protocols = plan.tasks[claim.tasks[0]].protocols
    found = verdicts(claim, results)
    rows = [["criterion", *(protocols[protocol].title for protocol in found)]]
    for criterion in dict.fromkeys(check.criterion for verdict in found.values() for check in verdict.checks):
        cells = (
            "; ".join(
                f"**{answers[each.passed]}**: {each.measured}" for each in verdict.checks if each.criterion == criterion
            )
            for verdict in found.values()
        )
        rows.append([criterion, *cells])
    return markdown_table(rows)


def _named_once(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """The rows of a table whose first cells are empty where they repeat the one above."""
    above = ["", *(row[0] for row in rows)]
    return [["" if row[0] == before else row[0], *row[1:]] for row, before in zip(rows, above, strict=False)]


def _score_table(task: str, plan: Plan, results: ReproductionResults) -> str:
    """The scores of a task: a row per protocol and variant, of the policy that samples its actions."""
    if task == FRONT_TASK:
        return _front_score_table(plan, results)
    vehicles = 2 if task.startswith("intersection") else 1
    score, progress = utility_metric(task), vehicle_prefix(0, vehicles) + return_of("distance")
    measures = ["utility (ESR)", "success rate", "collisions", "progress (m)"]
    rows = [["protocol", "algorithm", "seeds", "steps", *measures]]
    for protocol in results.protocols(task):
        for variant, label in results.variants(task, protocol).items():
            values = partial(results.values, task, protocol, variant, policy=STOCHASTIC)
            width = partial(results.episodes_width, task, protocol, variant, policy=STOCHASTIC)
            about = [plan.tasks[task].protocols[protocol].title, label, str(len(values(SUCCESS)))]
            rates = [percent(iqm(values(metric)), width(metric)) for metric in (SUCCESS, end_by(COLLISION))]
            utility, distance = (iqm(values(metric)).text(width(metric)) for metric in (score, progress))
            steps = _steps(results, task, protocol, variant)
            rows.append([*about, steps, utility, *rates, distance])
    return markdown_table(_named_once(rows))


def _front_score_table(plan: Plan, results: ReproductionResults) -> str:
    """The scores of PCN's fronts: a row per protocol."""
    measures = ["hypervolume", "collapsed runs", "non-dominated policies", "progress of the policies (m)"]
    rows = [["protocol", "seeds", "steps", *measures]]
    for protocol in results.protocols(FRONT_TASK):
        values = partial(results.values, FRONT_TASK, protocol, FRONT_VARIANT, policy=FRONT)
        title = plan.tasks[FRONT_TASK].protocols[protocol].title
        steps = _steps(results, FRONT_TASK, protocol, FRONT_VARIANT)
        hypervolume, cardinality, nearest, farthest = (
            iqm(values(metric)) for metric in (HYPERVOLUME, CARDINALITY, LOWEST_DISTANCE, HIGHEST_DISTANCE)
        )
        progress = f"{nearest.value:.2g} to {farthest.value:.3g}"
        volumes = values(HYPERVOLUME)
        collapsed = f"{(volumes < COLLAPSED * np.median(volumes)).sum()} of {len(volumes)}"
        rows.append([title, str(len(volumes)), steps, hypervolume.text(), collapsed, cardinality.text(), progress])
    return markdown_table(rows)


def _steps(results: ReproductionResults, task: str, protocol: str, variant: str) -> str:
    """The number of environment steps of a variant's runs, as text."""
    keys = (task, protocol, variant)
    return f"{next(row['steps'] for row in results.scores if _keys(row) == keys):,}"


def _keys(row: Mapping[str, Any]) -> tuple[str, str, str]:
    return row["task"], row["protocol"], row["variant"]


def is_ablation(protocol: Protocol) -> bool:
    """Whether a protocol is an ablation, instead of a comparison of A2C and MO-A2C or a run of PCN."""
    return set(protocol.variants) != {BASELINE, MULTI_OBJECTIVE} and set(protocol.variants) != {FRONT_VARIANT}


def _ablation_table(task: str, protocol_key: str, protocol: Protocol, results: ReproductionResults) -> str:
    """The scores of an ablation: a row per variant, with its difference from the first one."""
    rows = [["change", "utility (ESR)", "success rate", "difference from the first", "P(higher than the first)"]]
    metric = utility_metric(task)
    labels = results.variants(task, protocol_key)
    variants = [variant for variant in protocol.variants if variant in labels]
    baseline = results.values(task, protocol_key, variants[0], metric) if variants else np.zeros(0)
    for variant in variants:
        values = results.values(task, protocol_key, variant, metric)
        success = percent(iqm(results.values(task, protocol_key, variant, SUCCESS)))
        effect = ["", ""]
        if variant != variants[0]:
            effect = [iqm_difference(values, baseline).text(), probability_of_improvement(values, baseline).text()]
        rows.append([labels[variant], iqm(values).text(), success, *effect])
    return markdown_table(rows)


# ---------------------------------------------------------------------------------------------------------- document


def _document(
    plan: Plan, results: ReproductionResults, figure_paths: dict[int, list[Path]], how: str, quick: bool
) -> str:
    """The whole report as Markdown."""
    runs = {(row["task"], row["protocol"], row["variant"], row["seed"]): row["seconds"] for row in results.scores}
    seeds = sorted({row["seed"] for row in results.scores})
    parts = [
        "# Reproduction of the paper's figures and claims",
        f"Written by `{how}`: {len(runs)} runs, {sum(runs.values()) / 3600:.1f} hours on one core, seeds {seeds[0]} to "
        f"{seeds[-1]}. Background: [reproduction](../reproduction.md).",
        "Scores are interquartile means over seeds of the utility (ESR) of the policy that samples its actions; at the "
        "intersection, of the sum of both vehicles' utilities. "
        "The episodes of each evaluation, greedy policies, and intervals over the episodes of one run are in "
        "reproduction_scores.csv.",
        "Intervals (95%, bootstrap) are over seeds. P(MO-A2C higher) is the probability that a run of MO-A2C scores "
        "higher than one of A2C. A run of PCN has collapsed if its hypervolume is below "
        f"{COLLAPSED:.0%} of the median.",
        *([f"**{QUICK}**"] if quick else []),
        "## Verdicts",
        verdict_table(plan, results, quick=quick),
    ]
    for claim in CLAIMS:
        if not verdicts(claim, results):
            continue
        parts += [f"## Claim {claim.number}", _check_table(plan, claim, results)]
        for task in claim.tasks:
            parts += [f"### {plan.tasks[task].title}", _comparison_table(task, plan, results)]
            parts += _ablations(task, plan, results)
        for figure in claim.figures:
            pictures = [f"![Figure {figure}]({path.name})" for path in figure_paths.get(figure, [])]
            parts += [picture for picture in pictures if picture not in parts]  # claims share figures
    claimed = {task for claim in CLAIMS for task in claim.tasks}
    for task in plan.tasks:
        if task not in claimed and results.protocols(task):
            parts += [f"## {plan.tasks[task].title}", _comparison_table(task, plan, results)]
            parts += _ablations(task, plan, results)
    return "\n\n".join(parts) + "\n"


def _comparison_table(task: str, plan: Plan, results: ReproductionResults) -> str:
    """The scores of a task's protocols that are not ablations."""
    protocols = plan.tasks[task].protocols
    compared = [protocol for protocol in results.protocols(task) if not is_ablation(protocols[protocol])]
    kept = ReproductionResults([row for row in results.scores if row["protocol"] in compared], [])
    return _score_table(task, plan, kept)


def _ablations(task: str, plan: Plan, results: ReproductionResults) -> list[str]:
    """Title and table of each ablation of a task."""
    parts = []
    for key in results.protocols(task):
        protocol = plan.tasks[task].protocols[key]
        if is_ablation(protocol):
            parts += [f"**{protocol.title}**", _ablation_table(task, key, protocol, results)]
    return parts
