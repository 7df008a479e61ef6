"""The final evaluation of a run as numbers with 95% intervals over its episodes, as a table."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from mo_deepdrive.evaluation.metrics import (
    DISCOUNTED_UTILITY_ESR,
    DISCOUNTED_UTILITY_SER,
    END,
    SUCCESS,
    UTILITY_ESR,
    UTILITY_SER,
    return_of,
    split_name,
)
from mo_deepdrive.evaluation.statistics import Estimate, of_three, rate

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mo_deepdrive.evaluation.evaluation import Evaluation

# Metrics that may have the values of another one.
_REPEATED = {
    UTILITY_SER: UTILITY_ESR,
    DISCOUNTED_UTILITY_SER: DISCOUNTED_UTILITY_ESR,
    return_of("destination"): SUCCESS,
}


def evaluation_table(evaluations: Mapping[str, Evaluation], title: str) -> Table:
    """A table with a row per metric and a column per policy.

    Ends that no episode had and metrics that repeat another one (SER of a linear utility, the return of our
    destination) are left out; the files have all.
    """
    columns = {policy: evaluation.estimates() for policy, evaluation in evaluations.items()}
    names: list[str] = []
    for estimates in columns.values():
        place = 0
        for name in estimates:
            if name not in names:
                names.insert(place, name)
            place = names.index(name) + 1
    names = [name for name in names if _says_more(name, list(columns.values()))]
    for policy, evaluation in evaluations.items():
        never = rate(np.zeros(len(evaluation.returns), dtype=np.bool_))
        if any(map(_is_end, columns[policy])):
            columns[policy] = {**dict.fromkeys(filter(_is_end, names), never), **columns[policy]}
    how = f"95% intervals{of_three((len(each.returns) for each in evaluations.values()), 'episodes')}"
    result = Table(title=f"{title}; {how}", title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    result.add_column("", overflow="fold")
    if any(_is_end(name) for estimates in columns.values() for name in estimates):
        result.caption = f"{SUCCESS}: the share of arrivals; other ends ({END}...) that no episode had are left out."
        result.caption_justify = "left"
    for policy in columns:
        result.add_column(policy, justify="right", overflow="fold")
    for name in names:
        cells = [estimates[name].text() if name in estimates else "" for estimates in columns.values()]
        result.add_row(name, *(cell.replace("[", r"\[") for cell in cells))
    return result


def _is_end(name: str) -> bool:
    return split_name(name).metric.startswith(END)


def _says_more(name: str, columns: Sequence[Mapping[str, Estimate]]) -> bool:
    """Whether a metric is not that of an end that no episode had, and differs from the metric that it may repeat."""
    metric = split_name(name).metric
    if _is_end(name):
        return any(name in column and column[name].value > 0.0 for column in columns)
    if metric in _REPEATED:
        other = name.removesuffix(metric) + _REPEATED[metric]
        pairs = [(column[name].value, column[other].value) for column in columns if name in column and other in column]
        return not pairs or not all(math.isclose(*pair, rel_tol=1e-9, abs_tol=1e-9) for pair in pairs)
    return True
