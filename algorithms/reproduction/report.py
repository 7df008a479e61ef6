"""The verdicts and tables of a reproduction as Markdown, and everything it leaves in a folder."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from algorithms.common.atomic_io import atomic_write
from algorithms.evaluation.front import Front
from algorithms.evaluation.statistics import Estimate, iqm, iqm_difference, probability_of_improvement
from algorithms.reporting.front_plots import draw_front
from algorithms.reproduction.claims import (
    BASELINE,
    CLAIMS,
    MULTI_OBJECTIVE,
    Claim,
    Verdict,
    compare,
    percent,
    utility_kind,
    utility_metric,
)
from algorithms.reproduction.figures import CURVES, FRONTS, draw_curves, file_name
from algorithms.reproduction.plan import Arm, Cell, Entry, Plan
from algorithms.reproduction.results import Results

REPORT_FILE = "reproduction.md"
FRONT_CELL, FRONT_VARIANT = "one_waypoint_front", "pcn"
# The verdict table of another document stands between these lines.
BEGIN, END = "<!-- verdicts: written by scripts/reproduce.py -->", "<!-- end of verdicts -->"


def write_report(plan: Plan, results: Results, directory: Path, figures: Sequence[int], *, how: str) -> list[Path]:
    """Write the tables, the report and the figures of everything that has results.

    Args:
        plan: what was to be trained.
        results: what came of it.
        directory: where to write.
        figures: of the paper, to be drawn; those of fronts are drawn from the fronts kept in ``directory``.
        how: the command that makes the same again, for the report.

    Returns:
        The files.

    Raises:
        OSError: if a file cannot be written; each is whole or as it was.
    """
    results.write(directory)
    drawn: dict[int, list[Path]] = {}
    for figure in figures:
        if figure in CURVES:
            path = directory / file_name(figure)
            drawn[figure] = [path] if draw_curves(figure, plan, results, path) else []
        else:
            drawn[figure] = _draw_front_figure(figure, directory)
    text = _document(plan, results, drawn, how)
    atomic_write(directory / REPORT_FILE, text.encode())
    return [directory / REPORT_FILE, *(path for paths in drawn.values() for path in paths)]


# ------------------------------------------------------------------------------------------------------------ fronts


def median_entry(entries: Sequence[Entry], results: Results, metric: str, policy: str) -> Entry | None:
    """Of finished runs of one variant the one whose score is the median, the lower of two; None where there is none."""
    scored = []
    for entry in entries:
        for row in results.scores:
            same = (row["cell"], row["arm"], row["variant"], row["seed"], row["policy"])
            if same == (entry.cell, entry.arm, entry.variant, entry.seed, policy) and metric in row:
                scored.append((row[metric], entry.seed, entry))
    if not scored:
        return None
    scored.sort(key=lambda each: each[:2])
    return scored[(len(scored) - 1) // 2][2]


def keep_fronts(entries: Sequence[Entry], results: Results, directory: Path) -> None:
    """Keep the front of the run with the median hypervolume of every arm, so that its figures can be drawn again."""
    for arm in results.arms(FRONT_CELL):
        mine = [entry for entry in entries if (entry.cell, entry.arm) == (FRONT_CELL, arm)]
        chosen = median_entry(mine, results, "hypervolume", "front")
        if chosen is not None:
            folder = directory / f"front_{arm}"
            folder.mkdir(exist_ok=True)
            Front.read(chosen.job.path).write(folder, {"seed_of_the_run": chosen.seed})


def _draw_front_figure(figure: int, directory: Path) -> list[Path]:
    paths = []
    for folder in sorted(directory.glob("front_*")):
        if not folder.is_dir():
            continue
        arm = folder.name.removeprefix("front_")
        path = directory / file_name(figure).replace(".png", f"_{arm}.png")
        with tempfile.TemporaryDirectory() as scratch:
            draw_front(Front.read(folder), scratch, title=f"Figure {figure}. PCN on OneWaypoint")
            atomic_write(path, (Path(scratch) / f"{FRONTS[figure]}.png").read_bytes())
        paths.append(path)
    return paths


# ------------------------------------------------------------------------------------------------------------ tables


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table, header first."""
    header, *body = rows
    lines = [header, ["---"] * len(header), *body]
    return "\n".join("| " + " | ".join(cell.replace("|", "/") for cell in line) + " |" for line in lines)


def verdict_table(plan: Plan, results: Results) -> str:
    """A row per claim and arm: the scores, the effect and the verdict."""
    rows = [["claim", "arm", "A2C", "MO-A2C", "difference", "P(MO-A2C higher)", "verdict"]]
    for claim in CLAIMS:
        for arm, verdict in verdicts(claim, results).items():
            title = plan.cells[claim.cells[0]].arms[arm].title
            for i, cell in enumerate(claim.cells):
                which = f" ({utility_kind(cell)})" if len(claim.cells) > 1 else ""
                name = f"{claim.number}. {claim.statement}" if i == 0 else ""
                word = f"**{verdict.word}**" if i == 0 else ""
                rows.append([name, title + which, *_effect(results, cell, arm), word])
    return markdown(rows)


def _effect(results: Results, cell: str, arm: str) -> list[str]:
    if cell == FRONT_CELL:
        count = iqm(results.values(cell, arm, FRONT_VARIANT, "cardinality", "front"))
        return ["", "", f"PCN: {count.text()} non-dominated policies", ""]
    found = compare(results, cell, arm, utility_metric(cell))
    pair = found.baseline, found.multi_objective, found.difference, found.improvement
    return [estimate.text() for estimate in pair]


def verdicts(claim: Claim, results: Results) -> dict[str, Verdict]:
    """The verdict of every arm that has results in all cells of the claim."""
    found = {}
    for arm in results.arms(claim.cells[0]):
        verdict = claim.judge(results, arm)
        if verdict is not None:
            found[arm] = verdict
    return found


def _checks(plan: Plan, claim: Claim, results: Results) -> str:
    rows = [["arm", "test", "measured", "holds"]]
    answers = {True: "yes", False: "no", None: "open"}
    for arm, verdict in verdicts(claim, results).items():
        title = plan.cells[claim.cells[0]].arms[arm].title
        rows += [[title, check.asks, check.measured, answers[check.holds]] for check in verdict.checks]
    return markdown(rows)


def _scores(cell_key: str, cell: Cell, results: Results) -> str:
    """A row per variant and policy of one cell."""
    if cell_key == FRONT_CELL:
        return _front_scores(cell, results)
    vehicles = cell_key.startswith("intersection")
    rows = [["arm", "algorithm", "policy", "seeds", "steps", "utility (ESR)", "arrivals", "collisions", "progress (m)"]]
    for arm in results.arms(cell_key):
        for variant, label in results.variants(cell_key, arm).items():
            for policy in ("stochastic", "greedy"):

                def value(metric: str) -> Estimate:
                    return iqm(results.values(cell_key, arm, variant, metric, policy))  # noqa: B023

                progress = "vehicle_0/return/distance" if vehicles else "return/distance"
                seeds = len(results.values(cell_key, arm, variant, "success", policy))
                about = [cell.arms[arm].title, label, policy, str(seeds), _steps(results, cell_key, arm, variant)]
                rates = [percent(value("success")), percent(value("end/collision"))]
                rows.append([*about, value(utility_metric(cell_key)).text(), *rates, value(progress).text()])
    return markdown(rows)


def _front_scores(cell: Cell, results: Results) -> str:
    rows = [["arm", "seeds", "steps", "hypervolume", "non-dominated policies", "progress of the policies (m)"]]
    for arm in results.arms(FRONT_CELL):

        def value(metric: str) -> Estimate:
            return iqm(results.values(FRONT_CELL, arm, FRONT_VARIANT, metric, "front"))  # noqa: B023

        seeds = results.values(FRONT_CELL, arm, FRONT_VARIANT, "hypervolume", "front")
        reach = f"{value('lowest_distance').value:.2g} to {value('highest_distance').value:.3g}"
        steps = _steps(results, FRONT_CELL, arm, FRONT_VARIANT)
        title = cell.arms[arm].title
        rows.append([title, str(len(seeds)), steps, value("hypervolume").text(), value("cardinality").text(), reach])
    return markdown(rows)


def _steps(results: Results, cell: str, arm: str, variant: str) -> str:
    where = (cell, arm, variant)
    return f"{next(r['steps'] for r in results.scores if (r['cell'], r['arm'], r['variant']) == where):,}"


def is_study(arm: Arm) -> bool:
    """Whether an arm changes one thing at a time, instead of comparing the two algorithms."""
    return set(arm.variants) != {BASELINE, MULTI_OBJECTIVE} and set(arm.variants) != {FRONT_VARIANT}


def _study(cell: str, arm_key: str, arm: Arm, results: Results) -> str:
    """A row per variant: its score, and its difference from the first of the arm."""
    rows = [["what", "utility (ESR)", "arrivals", "difference from the first", "P(higher than the first)"]]
    metric = utility_metric(cell)
    labels = results.variants(cell, arm_key)
    variants = [variant for variant in arm.variants if variant in labels]
    base = results.values(cell, arm_key, variants[0], metric) if variants else np.zeros(0)
    for variant in variants:
        values = results.values(cell, arm_key, variant, metric)
        arrivals = percent(iqm(results.values(cell, arm_key, variant, "success")))
        effect = ["", ""]
        if variant != variants[0]:
            effect = [iqm_difference(values, base).text(), probability_of_improvement(values, base).text()]
        rows.append([labels[variant], iqm(values).text(), arrivals, *effect])
    return markdown(rows)


# ---------------------------------------------------------------------------------------------------------- document


def _document(plan: Plan, results: Results, drawn: dict[int, list[Path]], how: str) -> str:
    runs = {(row["cell"], row["arm"], row["variant"], row["seed"]): row["seconds"] for row in results.scores}
    seeds = sorted({row["seed"] for row in results.scores})
    parts = [
        "# The paper's figures and claims, made again",
        f"Written by `{how}`: {len(runs)} runs, {sum(runs.values()) / 3600:.1f} hours of one core, seeds {seeds[0]} to "
        f"{seeds[-1]}. What was asked and why, and what the numbers say: [reproduction](../reproduction.md).",
        "Scores are interquartile means over seeds of the utility (ESR) of the stochastic policy in "
        f"{plan.overrides.get('evaluation.final_episodes', 200)} unseen episodes, with 95% bootstrap intervals; "
        "at the intersection, of the sum of both vehicles' utilities. P(MO-A2C higher) is the probability that a run "
        "of MO-A2C ends above one of A2C.",
        "## Verdicts",
        verdict_table(plan, results),
    ]
    for claim in CLAIMS:
        if not verdicts(claim, results):
            continue
        parts += [f"## Claim {claim.number}", f"{claim.statement}.", _checks(plan, claim, results)]
        for cell in claim.cells:
            parts += [f"### {plan.cells[cell].title}", _comparison_scores(cell, plan, results)]
            parts += _studies(cell, plan, results)
        for figure in claim.figures:
            parts += [f"![Figure {figure}]({path.name})" for path in drawn.get(figure, [])]
    claimed = {cell for claim in CLAIMS for cell in claim.cells}
    for cell in plan.cells:
        if cell not in claimed and results.arms(cell):
            parts += [f"## {plan.cells[cell].title}", _comparison_scores(cell, plan, results)]
            parts += _studies(cell, plan, results)
    return "\n\n".join(parts) + "\n"


def _comparison_scores(cell: str, plan: Plan, results: Results) -> str:
    compared = [arm for arm in results.arms(cell) if not is_study(plan.cells[cell].arms[arm])]
    kept = Results([row for row in results.scores if row["arm"] in compared], [])
    return _scores(cell, plan.cells[cell], kept)


def _studies(cell: str, plan: Plan, results: Results) -> list[str]:
    parts = []
    for key in results.arms(cell):
        arm = plan.cells[cell].arms[key]
        if is_study(arm):
            parts += [f"**{arm.title}**", _study(cell, key, arm, results)]
    return parts


def insert_verdicts(path: Path, plan: Plan, results: Results) -> None:
    """Replace the verdict table of another document, between BEGIN and END.

    Raises:
        ValueError: if the document does not have these lines.
        OSError: if it cannot be written.
    """
    text = path.read_text(encoding="utf-8")
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ValueError(f"{str(path)!r} has no place for the verdicts, between {BEGIN!r} and {END!r}")
    table = f"{BEGIN}\n\n{verdict_table(plan, results)}\n\n{END}"
    replaced = re.sub(f"{re.escape(BEGIN)}.*{re.escape(END)}", lambda _: table, text, flags=re.DOTALL)
    atomic_write(path, replaced.encode())
