"""All tables: final scores over seeds and their comparisons, evaluations of a run; on a terminal and in files.

A table is a list of rows of cells, its header first, of which the first columns, the labels, say what a row is. Files
are CSV, tidy, for programs, or LaTeX and Markdown, for papers and pages.
"""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import combinations, product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.table import Table
from rich.text import Text

from algorithms.reporting.run_records import (
    EvaluationRecord,
    distinct_labels,
    find_runs,
    group_by_experiment,
    identifying_settings,
    label_of,
    read_runs,
)
from algorithms.reporting.style import algorithm_label, algorithm_order
from mo_deepdrive.evaluation.metrics import (
    ADDITIVE_EPSILON,
    CARDINALITY,
    COLLISION,
    END,
    EXPECTED_UTILITY,
    FRONT,
    HYPERVOLUME,
    IGD_PLUS,
    LENGTH,
    POLICIES,
    RETURN,
    SUCCESS,
    SUITE_SCORE,
    UTILITY_ESR,
    UTILITY_SER,
    MetricName,
    end_by,
    mean_of,
    return_of,
    split_name,
    title_of,
)
from mo_deepdrive.evaluation.statistics import (
    MIN_SAMPLES,
    Estimate,
    interquartile_mean,
    iqm_difference,
    mann_whitney_p,
    mean_difference,
    means,
    of_three,
    rate,
)
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes
from mo_deepdrive.support.names import nearest_few

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from rich.console import Console

    from mo_deepdrive.evaluation.evaluation import Evaluation

Rows = list[list[str]]
Cells = list[list[Any]]  # with one number per cell

# The columns of tables that are read; CSV files also have the returns of all objectives.
TABLE_METRICS = (
    *(UTILITY_ESR, UTILITY_SER, SUCCESS, end_by(COLLISION), return_of("lane_violation")),
    *(LENGTH, mean_of("g_force"), mean_of("jerk")),
    *(HYPERVOLUME, CARDINALITY, EXPECTED_UTILITY, IGD_PLUS, ADDITIVE_EPSILON),
)
UTILITY_IQM = f"{UTILITY_ESR}_iqm"  # the interquartile mean over seeds
TABLE_COLUMNS = (*TABLE_METRICS, UTILITY_IQM)
COMPARED = ("mean", "low", "high", "n", "n_other", "p")  # columns of a comparison

FORMATS = (".csv", ".md", ".tex")
DIFFERENCES = "-differences"  # after the name of a file
PADDING, MARGIN = 3, 1  # of a column, and of a table, in SIMPLE_HEAD
LABEL_SHARE = 0.6  # of the width of a terminal, the most that labels may take
_LATEX = {
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "|": r"\textbar{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "²": "$^2$",
    "³": "$^3$",
}
# ----------------------------------------------------------------------------------------------- scores over seeds


@dataclass
class ScoreGroup:
    """The final scores of runs that differ in their seed alone."""

    about: dict[str, str]  # the first cells of its rows, by column
    task: dict[str, str]  # those of them that groups to be compared have in common
    algorithm: str  # in which such groups differ
    measured: str  # what else they must share, as text
    seeds: list[int] = field(default_factory=list)  # of the runs that have scores
    # A value per seed; the vehicle is "" for the scores of the only vehicle, or of all together.
    scores: dict[MetricName, list[float]] = field(default_factory=lambda: defaultdict(list))
    wanted: int | None = None  # how many seeds there are to be, if that is known
    # Of the scores' own intervals, over evaluation episodes, where they are known.
    widths: dict[MetricName, list[float]] = field(default_factory=lambda: defaultdict(list))
    evaluation: EvaluationRecord = field(default_factory=EvaluationRecord)  # how the runs were evaluated

    @property
    def rows(self) -> list[tuple[str, str]]:
        """The policy and the vehicle of each of its rows; of vehicles "" first."""
        known = {policy for policy, _, _ in self.scores}
        vehicles = sorted({vehicle for _, vehicle, _ in self.scores})
        return [*product((policy for policy in POLICIES if policy in known), vehicles)]

    @property
    def seeds_text(self) -> str:
        """The seeds; if it is known how many there are to be, their number."""
        if self.wanted is None:
            return " ".join(str(seed) for seed in sorted(self.seeds))
        return str(self.wanted) if len(self.seeds) == self.wanted else f"{len(self.seeds)} of {self.wanted}"

    def labels(self, about: Sequence[str], policy: str, vehicle: str) -> list[str]:
        """The first cells of a row."""
        return [*(self.about.get(name, "") for name in about), policy, vehicle, self.seeds_text]

    def values(self, place: MetricName) -> list[float]:
        """The scores of one policy, vehicle and metric.

        Evaluations in another library's environment may have a success rate only if some episode succeeded
        (:mod:`mo_deepdrive.evaluation.evaluation`): where one seed has it, it is 0 for those evaluated without.
        """
        place = place._replace(metric=UTILITY_ESR) if place.metric == UTILITY_IQM else place
        known = self.scores.get(place, [])
        evaluated = self.scores.get(place._replace(metric=LENGTH), []) if known and place.metric == SUCCESS else []
        return known + [0.0] * (len(evaluated) - len(known))


class ScoreEstimate(NamedTuple):
    """A score of a group over its n seeds; ``text`` has the digits that the intervals support."""

    group: ScoreGroup
    place: MetricName
    mean: Estimate
    n: int
    text: str


def group_runs(paths: Sequence[Path], warn: Callable[[str], None], *, everything: bool = False) -> list[ScoreGroup]:
    """Group the finished runs among and below ``paths`` by :mod:`algorithms.reporting.run_records`.

    Of metrics those of tables and the returns are read, or ``everything``; ``warn`` is told which runs are left out.
    """
    members = group_by_experiment(read_runs(find_runs(paths, warn), warn, scores=True))
    experiments = [runs[0].experiment for runs in members]
    environments, utilities = (
        distinct_labels(list(map(label_of, sections)), sections)
        for sections in ([e.environment for e in experiments], [e.utility for e in experiments])
    )
    groups = []
    for experiment, runs, environment, utility in zip(experiments, members, environments, utilities, strict=True):
        task = {"environment": environment, "utility": utility}
        steps = experiment.training.total_timesteps
        about = {**task, "algorithm": experiment.algorithm.name, "steps": "" if steps is None else str(steps)}
        measured = f"{experiment.task_key} {experiment.evaluation.split}"
        group = ScoreGroup(about, task, experiment.algorithm.name, measured, evaluation=experiment.evaluation)
        for run in runs:
            group.seeds.append(run.experiment.training.seed)
            collides = any(name.endswith(return_of(COLLISION)) for name in run.scores)
            for name, score in run.scores.items():
                place = split_name(name)
                if place.metric == end_by(COLLISION) and not (collides or score.value):
                    continue  # there is nothing to collide with
                if everything or place.metric in TABLE_METRICS or place.metric.startswith(RETURN):
                    group.scores[place].append(score.value)
                    if score.low is not None and score.high is not None:
                        group.widths[place].append(score.high - score.low)
        groups.append(group)
    names = [" ".join(group.about.values()) for group in groups]
    settings = [identifying_settings(experiment) for experiment in experiments]
    for group, name, distinct in zip(groups, names, distinct_labels(names, settings), strict=True):
        group.about["settings"] = distinct.removeprefix(name).strip()
    return sorted(groups, key=lambda group: (*group.task.values(), algorithm_order(group.algorithm)))


def score_estimates(groups: Sequence[ScoreGroup], metrics: Sequence[str] | None = None) -> list[ScoreEstimate]:
    """The means over seeds with their intervals, and the interquartile means of the utilities, which have none.

    Without ``metrics`` those are :data:`TABLE_METRICS` and all others of the groups.
    """
    wanted = metrics or [*TABLE_METRICS, UTILITY_IQM, *(place.metric for group in groups for place in group.scores)]
    places = [
        (group, place)
        for group in groups
        for (policy, vehicle), metric in product(group.rows, dict.fromkeys(wanted))
        if group.values(place := MetricName(policy, vehicle, metric))
    ]
    samples = [group.values(place) for group, place in places]
    estimates = []
    for (group, place), values, mean in zip(places, samples, means(samples), strict=True):
        text = mean.text(float(np.mean(group.widths.get(place, [0.0]))))
        if place.metric == UTILITY_IQM:
            mean = Estimate(interquartile_mean(np.array(values)))
            text = f"{mean.value:.3f}"
        estimates.append(ScoreEstimate(group, place, mean, len(values), text))
    return estimates


def scores_table(groups: Sequence[ScoreGroup], columns: Sequence[str] = TABLE_COLUMNS) -> Rows:
    """One row per group, policy and vehicle, one column per metric: the means over seeds with their intervals.

    Where two groups were measured alike, and no more, there are rows of their differences, second minus first.
    """
    about = _about(groups)
    rows: dict[tuple[int, str, str], list[str]] = {}
    for estimate in score_estimates(groups, columns):
        policy, vehicle, metric = estimate.place
        labels = estimate.group.labels(about, policy, vehicle)
        row = rows.setdefault((id(estimate.group), policy, vehicle), [*labels, *[""] * len(columns)])
        row[len(labels) + columns.index(metric)] = estimate.text
    body = [*rows.values(), *_difference_rows(groups, about, columns)]
    return without_empty_columns([[*about, "policy", "vehicle", "seeds", *columns], *body])


def _about(groups: Sequence[ScoreGroup]) -> list[str]:
    """The columns that say what the groups are."""
    return list(dict.fromkeys(name for group in groups for name in group.about))


def _difference_rows(groups: Sequence[ScoreGroup], about: Sequence[str], columns: Sequence[str]) -> Iterator[list[str]]:
    """Rows of :func:`scores_table` for every two groups that alone were measured alike, if the seeds suffice."""
    alike: dict[str, list[ScoreGroup]] = defaultdict(list)
    for group in groups:
        alike[group.measured].append(group)
    for first, second in (members for members in alike.values() if len(members) == 2):
        for policy, vehicle in first.rows:
            texts = zip(first.labels(about, policy, vehicle), second.labels(about, policy, vehicle), strict=True)
            labels = [old if old == new else f"{new or 'none'} minus {old or 'none'}" for old, new in texts]
            if first.seeds_text != second.seeds_text:
                labels[-1] = ""
            cells = []
            for metric in columns:
                place = MetricName(policy, vehicle, metric)
                samples = [np.array(group.values(place)) for group in (second, first)]
                enough = min(map(len, samples)) >= MIN_SAMPLES
                difference = iqm_difference if metric == UTILITY_IQM else mean_difference
                cells.append(difference(*samples).text() if enough else "")
            if any(cells):
                yield [*labels, *cells]


def check_columns(groups: Sequence[ScoreGroup], columns: Sequence[str] | None) -> None:
    """Refuse columns of which no group has a score."""
    known = {place.metric for group in groups for place in group.scores}
    known |= {UTILITY_IQM} if UTILITY_ESR in known else set()
    for name in set(columns or ()) - known:
        raise ValueError(f"--columns {name}: no run has such a score; the nearest: {nearest_few(name, known)}")


def tidy_scores(groups: Sequence[ScoreGroup], metrics: Sequence[str] | None = None) -> Cells:
    """One row per group, policy, vehicle and metric: mean, low and high end of its interval, and n, how many seeds."""
    about = _about(groups)
    rows: Cells = [[*about, "seeds", "policy", "vehicle", "metric", "mean", "low", "high", "n"]]
    for estimate in score_estimates(groups, metrics):
        labels = [estimate.group.about.get(name, "") for name in about]
        seeds = " ".join(map(str, sorted(estimate.group.seeds)))
        mean = estimate.mean
        rows.append([*labels, seeds, *estimate.place, mean.value, mean.low, mean.high, estimate.n])
    return rows


def tidy_comparisons(groups: Sequence[ScoreGroup]) -> Cells:
    """One row per policy and vehicle of two groups that differ in the algorithm: how their means differ.

    Columns are those of COMPARED, with p of a two-sided Mann-Whitney test, and the steps of both unless all have the
    same.
    """
    shared = list(groups[0].task) if groups else []
    rows: Cells = [[*shared, "policy", "vehicle", "difference", "steps", "metric", *COMPARED]]
    same_steps = len({group.about.get("steps", "") for group in groups}) == 1
    comparable: dict[tuple[str, ...], list[ScoreGroup]] = defaultdict(list)
    for group in groups:
        comparable[(*group.task.values(), group.measured)].append(group)
    in_order = (sorted(members, key=lambda group: algorithm_order(group.algorithm)) for members in comparable.values())
    for first, second in (pair for members in in_order for pair in combinations(members, 2)):
        if first.algorithm == second.algorithm:
            continue
        for policy, vehicle in first.rows:
            metric = HYPERVOLUME if policy == FRONT else UTILITY_ESR
            place = MetricName(policy, vehicle, metric)
            later, earlier = (np.array(group.scores.get(place, [])) for group in (second, first))
            if min(len(later), len(earlier)) < 2:
                continue
            mean = mean_difference(later, earlier)
            pairing = f"{second.algorithm} - {first.algorithm}"
            taken = dict.fromkeys(group.about.get("steps", "") for group in (second, first))
            steps = "" if same_steps else " against ".join(taken)
            numbers = [mean.value, mean.low, mean.high, len(later), len(earlier), mann_whitney_p(later, earlier)]
            rows.append([*first.task.values(), policy, vehicle, pairing, steps, metric, *numbers])
    return rows


def comparison_table(groups: Sequence[ScoreGroup]) -> Rows:
    """The rows of :func:`tidy_comparisons` as text."""

    def text(cell: str | float | None) -> str:
        return "" if cell is None else f"{cell:.3f}" if isinstance(cell, float) else str(cell)

    return without_empty_columns([[text(cell) for cell in row] for row in tidy_comparisons(groups)])


def without_empty_columns(rows: Rows) -> Rows:
    """The rows without the columns that only the header fills."""
    kept = [i for i in range(len(rows[0])) if any(row[i] for row in rows[1:])]
    return [[row[i] for i in kept] for row in rows]


def interval_note(groups: Sequence[ScoreGroup]) -> str:
    """What the numbers of a table and their intervals are, and which number to cite of a task of the suite."""
    sizes = {len(group.seeds) for group in groups}
    note = f"Means over seeds with 95% bootstrap intervals over seeds{of_three(sizes)}."
    if any(1 < size < MIN_SAMPLES for size in sizes):
        note += f" Fewer than {MIN_SAMPLES} seeds have no interval."
    if episodes := sorted({group.evaluation.label for group in groups} - {""}):
        note += f" Every run was evaluated at its end in {' or '.join(episodes)}."
    if tasks := sorted({group.evaluation.task for group in groups if group.evaluation.task}):
        note += (
            f" For {', '.join(tasks)} of the suite cite the score on the scenarios of the task, as the scoreboard does "
            f"(suite table, or --columns {SUITE_SCORE})."
        )
    return note


def print_runs(
    paths: Sequence[Path], console: Console, warn: Callable[[str], None], columns: Sequence[str] | None = None
) -> list[ScoreGroup]:
    """Print the scores of runs over seeds and the comparisons of their algorithms, task by task; returns the scores."""
    groups = group_runs(paths, warn, everything=columns is not None)
    if not groups:
        raise ValueError("no run has a final evaluation that can be read")
    check_columns(groups, columns)
    task = groups[0].task
    for title, rows in _by_task(scores_table(groups, columns or TABLE_COLUMNS), task).items():
        print_rows(console, rows, title, rows[0].index("seeds") + 1)
    for title, rows in _by_task(comparison_table(groups), task).items():
        print_rows(console, rows, f"{title}: differences of the algorithms", rows[0].index("mean"))
    console.print(interval_note(groups), highlight=False)
    return groups


def _by_task(rows: Rows, task: Iterable[str]) -> dict[str, Rows]:
    """The rows of each task without the columns that name it, which become its title."""
    header, *body = rows
    rest = [i for i, name in enumerate(header) if name not in task]
    tables: dict[str, Rows] = {}
    for row in body:
        title = ", ".join(cell for i, cell in enumerate(row) if i not in rest and cell)
        tables.setdefault(title, [[header[i] for i in rest]]).append([row[i] for i in rest])
    return {title: without_empty_columns(table) for title, table in tables.items()}


# ------------------------------------------------------------------------------------------- an evaluation of one run


def evaluation_table(evaluations: Mapping[str, Evaluation], title: str) -> Table:
    """A row per metric, a column per policy, with intervals over the episodes; without ends that no episode had."""
    columns = {policy: evaluation.estimates() for policy, evaluation in evaluations.items()}
    names = list(dict.fromkeys(name for estimates in columns.values() for name in estimates))
    ends = [name for name in names if split_name(name).metric.startswith(END)]
    happened = {name for name in ends for column in columns.values() if name in column and column[name].value > 0.0}
    rows = [["", *columns]]
    for name in (name for name in names if name not in ends or name in happened):
        cells = []
        for policy, estimates in columns.items():
            estimate = estimates.get(name)
            if estimate is None and name in ends and any(end in estimates for end in ends):  # this end never happened
                estimate = rate(np.zeros(len(evaluations[policy].returns), dtype=np.bool_))
            cells.append("" if estimate is None else estimate.text())
        rows.append([name, *cells])
    how = f"95% intervals{of_three((len(evaluation.returns) for evaluation in evaluations.values()), 'episodes')}"
    caption = (
        f"{SUCCESS}: the share of arrivals; other ends ({END}...) that no episode had are left out." if ends else ""
    )
    return make_table(rows, 1, title=f"{title}; {how}", caption=caption if ends else "")


# --------------------------------------------------------------------------------------------------------- a terminal


def make_table(
    rows: Rows, labels: int, *, unbroken: Container[int] = (), title: str | None = None, caption: str | None = None
) -> Table:
    """A table for a terminal: ``labels`` columns to the left, others to the right; of some no line is broken."""
    table = Table(title=title and Text(title, style="bold"), caption=caption and Text(caption), box=SIMPLE_HEAD)
    table.title_justify = table.caption_justify = "left"
    for i, name in enumerate(rows[0]):
        justify: Any = "left" if i < labels else "right"
        table.add_column(Text(name), justify=justify, overflow="fold", no_wrap=i in unbroken)
    for row in rows[1:]:
        table.add_row(*map(Text, row))
    return table


def print_rows(console: Console, rows: Rows, title: str, labels: int, *, rest: str | None = None) -> None:
    """Print a table below its title, in parts that fit the console, so that nothing is cut off.

    If it does not fit, first the labels that all rows share move to the title. With ``rest``, how to see all columns,
    the first part alone is printed, and then the names of the columns that are not in it.
    """
    if sum(_widths(rows)) + MARGIN > console.width and len(rows) > 1:
        shared, rows, labels = lift_labels(rows, labels)
        title = ", ".join(filter(None, [title, shared]))
    console.print(Text(title, style="bold"))
    tables = fitted_tables(rows, labels, console.width)
    for table in tables[: None if rest is None else 1]:
        console.print(table)
    if rest is not None and len(tables) > 1:
        shown = [str(column.header) for column in tables[0].columns]
        hidden = [name for name in rows[0][labels:] if name not in shown]
        console.print(Text(f"not shown: {', '.join(hidden)}; {rest}"))


def fitted_tables(rows: Rows, labels: int, width: int) -> list[Table]:
    """A table in parts that fit a width, each with the labels, and with those rows that have a value in it.

    Labels that take too much of the width are joined in one column ("name=value, name=value").
    """
    most = int(LABEL_SHARE * width)
    if labels > 1 and sum(_widths(rows)) + MARGIN > width and sum(_widths(rows)[:labels]) > most:
        header, *body = rows
        named = [[f"{name}={cell}" for name, cell in zip(header, row[:labels], strict=False) if cell] for row in body]
        joined = (", ".join(texts) for texts in named)
        rows = [["", *header[labels:]], *([text, *row[labels:]] for text, row in zip(joined, body, strict=True))]
        labels = 1
    widths = _widths(rows)
    room = width - MARGIN - min(sum(widths[:labels]), most)
    parts: list[list[int]] = [[]]
    for i in range(labels, len(widths)):
        if parts[-1] and sum(widths[k] for k in parts[-1]) + widths[i] > room:
            parts.append([])
        parts[-1].append(i)
    tables = []
    for part in parts:
        body = [row for row in rows[1:] if any(row[i] for i in part)]
        shown = [[row[i] for i in (*range(labels), *part)] for row in [rows[0], *body]]
        tables.append(make_table(shown, labels, unbroken=range(labels, len(shown[0]))))
    return tables


def _widths(rows: Rows) -> list[int]:
    return [max(map(cell_len, column)) + PADDING for column in zip(*rows, strict=True)]


def lift_labels(rows: Rows, labels: int) -> tuple[str, Rows, int]:
    """The labels that all rows share, as text; the rows without these, and how many labels are left."""
    header, *body = rows
    shared = [i for i in range(labels) if all(row[i] == body[0][i] for row in body)]
    text = ", ".join(f"{header[i]} {body[0][i]}" for i in shared if body[0][i])
    kept = [i for i in range(len(header)) if i not in shared]
    return text, [[row[i] for i in kept] for row in rows], labels - len(shared)


# -------------------------------------------------------------------------------------------------------------- files


def write_tables(
    path: Path, scores: Sequence[ScoreGroup], compared: Sequence[ScoreGroup], columns: Sequence[str] | None = None
) -> list[Path]:
    """Write the scores and, if algorithms can be compared, their differences into ``NAME-differences``.

    A CSV is tidy; LaTeX and Markdown have the table of the terminal, with names as people write them.
    """
    note, tidy = interval_note(scores), path.suffix.lower() == ".csv"
    table = tidy_scores(scores, columns) if tidy else scores_table(scores, columns or TABLE_COLUMNS)
    differences = tidy_comparisons(compared) if tidy else comparison_table(compared)
    tables = [(path, table, table[0].index("seeds") + 1, note)]
    if len(differences) > 1:
        other, text = path.with_stem(path.stem + DIFFERENCES), f"Differences of the algorithms. {note}"
        tables.append((other, differences, differences[0].index("mean"), text))
    for file, rows, labels, text in tables:
        write_table(file, rows if tidy else _in_words(rows, labels), labels, text)
    return [file for file, *_ in tables]


def _in_words(rows: Rows, labels: int) -> Rows:
    """A table with the names of algorithms and metrics as people write them."""
    header, *body = rows

    def words(column: str, cell: str) -> str:
        if column in ("algorithm", "difference"):
            return " ".join(map(algorithm_label, cell.split(" ")))
        return _title(cell) if column == "metric" else cell

    titles = [*header[:labels], *map(_title, header[labels:])]
    return [titles, *([words(name, cell) for name, cell in zip(header, row, strict=True)] for row in body)]


def _title(metric: str) -> str:
    return f"{title_of(UTILITY_ESR)} (IQM)" if metric == UTILITY_IQM else title_of(metric)


def write_table(path: Path, rows: Cells, labels: int, note: str) -> None:
    """Write one table in the format of the ending of its path, with the note below it, but not in a CSV."""
    suffix = path.suffix.lower()
    if suffix == ".csv":
        atomic_write(path, csv_bytes(rows))
    else:
        atomic_write(path, (latex if suffix == ".tex" else markdown)(rows, labels, note).encode())


def latex(rows: Rows, labels: int, note: str) -> str:
    """A tabular of the package booktabs; what all rows share, and the note, are comments."""
    shared, rows, labels = lift_labels(rows, labels)

    def line(cells: Sequence[str]) -> str:
        texts = ["".join(_LATEX.get(letter, letter) for letter in " ".join(cell.split())) for cell in cells]
        texts[labels:] = [re.sub(r"-(?=\d)", "$-$", text) for text in texts[labels:]]  # a minus, not a hyphen
        return " & ".join(texts) + r" \\"

    header, *body = rows
    columns = "l" * labels + "r" * (len(header) - labels)
    comments = [f"% {text}" for text in (r"needs \usepackage{booktabs}", *shared.splitlines(), note)]
    begin = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", line(header), r"\midrule"]
    return "\n".join([*comments, *begin, *map(line, body), r"\bottomrule", r"\end{tabular}", ""])


def markdown(rows: Rows, labels: int, note: str) -> str:
    """A table of GitHub's Markdown between what all rows share and the note."""
    shared, rows, labels = lift_labels(rows, labels)

    def line(cells: Sequence[str]) -> str:
        texts = (re.sub(r"([\\|])", r"\\\1", " ".join(cell.split())) for cell in cells)
        return f"| {' | '.join(texts)} |"

    header, *body = rows
    rule = ["---"] * labels + ["---:"] * (len(header) - labels)
    return "\n".join([*([shared, ""] if shared else []), line(header), line(rule), *map(line, body), "", note, ""])
