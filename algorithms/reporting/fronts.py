"""Fronts in files and in words: those evaluated during training, and what is said of the policies of a final one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from rich.console import Group
from rich.text import Text

from algorithms.reporting.tables import fitted_tables
from algorithms.reporting.training_log import POLICY, MetricsFile
from mo_deepdrive.evaluation.metrics import STEP, discounted_return_of, name_and_unit
from mo_deepdrive.evaluation.pareto import farthest_point_subset
from mo_deepdrive.evaluation.statistics import MIN_SAMPLES, Estimate, of_three

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.front import Front

FILMED_POLICIES = 4
MAX_FRAMES = 1000  # of every policy that is filmed; an episode of ours has 601 unless its time limit is changed
TABLE_ROWS = 12  # policies in the table; front.csv has all


class FrontsFile(MetricsFile):
    """A CSV file of every front evaluated during training: one row per policy, with step and discounted returns."""

    def write_front(self, step: int, front: Front) -> None:
        """Append a front."""
        names = [discounted_return_of(name) for name in front.objectives]
        returns = [dict(zip(names, map(repr, values), strict=True)) for values in front.discounted.tolist()]
        self._append([{STEP: str(step), POLICY: str(k), **cells} for k, cells in enumerate(returns)])


def covering_policies(front: Front, count: int) -> NDArray[np.intp]:
    """``count`` policies that cover a front (all if it has fewer), judged and ordered by discounted returns."""
    extent = np.ptp(front.discounted, axis=0)
    chosen = farthest_point_subset(front.discounted, count, np.where(extent > 0.0, extent, 1.0))
    return chosen[np.argsort(front.discounted[chosen, 0], kind="stable")]


def front_table(front: Front, measured: Mapping[str, float], title: str, width: int, whole: str = "") -> Group:
    """A table of some policies of a front with the intervals of their returns, and the front's indicators below it."""
    indicators = [
        f"{name.replace('_', ' ')} {f'{value:,.0f}' if value >= 1e4 else f'{value:.4g}'}"
        for name, value in measured.items()
    ]
    arrivals = bool(np.isfinite(front.success).all())
    shown = [i for i in range(len(front.objectives)) if not front.is_arrival_rate(i)]
    rows = [["policy", *(front.objectives[i] for i in shown), *(["arrivals"] if arrivals else []), "decisions"]]
    chosen = covering_policies(front, TABLE_ROWS).tolist()
    for k in chosen:
        cells = [f"{front.returns[k, i]:.4g}" for i in shown]
        if front.episodes >= MIN_SAMPLES:
            ends = [front.returns[k], front.low[k], front.high[k]]
            cells = [Estimate(*(float(values[i]) for values in ends)).text() for i in shown]
        share = [f"{front.success[k]:.0%}"] if arrivals else []
        rows.append([str(k), *cells, *share, f"{front.length[k]:.0f}"])
    count = f"{len(front)} policies"
    if len(chosen) < len(front):
        count = f"{len(chosen)} of {count}, which cover the front" + (f" ({whole})" if whole else "")
    heading = Text(f"{title}: {count}; undiscounted returns, {episodes_note(front.episodes)}", style="bold")
    return Group(heading, *fitted_tables(rows, 1, width), Text(", ".join(indicators)))


def episodes_note(episodes: int) -> str:
    """Of how many episodes of each policy the numbers of a table are."""
    intervals = f", 95% intervals{of_three([episodes], 'episodes')}" if episodes >= MIN_SAMPLES else ""
    return f"{episodes} episode{'' if episodes == 1 else 's'} each{intervals}"


def caption(front: Front, k: int) -> str:
    """The returns of policy ``k`` in words: ``policy 3, mean of 100 episodes: distance 14.5 m, g-force -5.8 g``."""
    named = [name_and_unit(objective) for objective in front.objectives]
    parts = [f"{name} {value:.3g} {unit}".rstrip() for (name, unit), value in zip(named, front.returns[k], strict=True)]
    episodes = f", mean of {front.episodes} episodes" if front.episodes > 1 else ""
    return f"policy {k}{episodes}: {', '.join(parts)}"
