"""Which objectives conflict: rank correlations of the returns over a population of drivers.

The population is the same in every scenario: random driving rules, which see the waypoints and their own motion alone
(:mod:`algorithms.planning.driving_rules`). In LeftTurn there is a second one, fixed rules that see the traffic
(:mod:`algorithms.driving.left_turn_rules`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from matplotlib.figure import Figure

from algorithms.driving.left_turn_rules import GapDriver, GapRule
from algorithms.planning.driving_rules import follow_rules, random_rules
from algorithms.reporting.style import INK, figure_style, save_figure, surround
from mo_deepdrive.actions import action_table
from mo_deepdrive.atomic_io import atomic_write, csv_bytes
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import OUR_ENVS, evaluate, evaluate_each
from mo_deepdrive.evaluation.function_policy import FunctionPolicy
from mo_deepdrive.evaluation.metrics import name_and_unit
from mo_deepdrive.evaluation.statistics import Estimate, estimate
from mo_deepdrive.scenarios import SCENARIOS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.evaluation import Evaluation

    Floats = NDArray[np.float64]

ARRIVALS = 0.25  # share of episodes in which a driver has to arrive to count
LEAST_DRIVERS = 10  # that a correlation needs
GAMMA = 0.99  # of the discount that tells the time


class RuleDrivers:
    """N driving rules as one policy of N episodes.

    A second vehicle is driven by the same rule, but does not wait.

    Args:
        rules: (N,) of RULE.
        decision: seconds of a decision.
    """

    def __init__(self, rules: NDArray[Any], decision: float = 0.1):
        self.rules = rules
        self.decision = decision
        self.table = action_table("discrete")

    def __call__(
        self, observations: NDArray[Any], _accrued: NDArray[Any], discounts: NDArray[Any]
    ) -> NDArray[np.int64]:
        """Actions (N,) or (N, V) for observations (N, size) or (N, V, size)."""
        shape = observations.shape[:-1]
        rules = np.array(np.broadcast_to(self.rules.reshape((-1,) + (1,) * (len(shape) - 1)), shape))
        if len(shape) == 2:
            rules["wait"][:, 1:] = 0.0
        times = np.log(discounts) / np.log(GAMMA) * self.decision
        actions = np.zeros((*shape, 1), dtype=np.int64)
        follow_rules(
            observations.reshape(-1, observations.shape[-1]),
            rules.ravel().view(np.recarray),
            np.broadcast_to(times, shape).ravel(),
            self.table,
            actions.reshape(-1, 1),
        )
        return actions[..., 0]


@dataclass(frozen=True)
class Conflicts:
    """Rank correlations of the mean returns of a population.

    Attributes:
        population: the scenario's title, and the drivers if they are others.
        objectives: names of the d objectives.
        drivers: how many drivers count.
        correlations: per pair of objectives Spearman's coefficient with its 95% interval over the drivers; NaN where
            an objective is the same for all.
    """

    population: str
    objectives: tuple[str, ...]
    drivers: int
    correlations: dict[tuple[str, str], Estimate]


def find_conflicts(scenario: str, *, drivers: int, episodes: int, seed: int, rng_seed: int = 0) -> Conflicts:
    """Correlate the returns of random drivers in a scenario; those of the vehicle that turns left in Intersection.

    Args:
        scenario: its name.
        drivers: how many are drawn; those that arrive in at least ARRIVALS of their episodes count.
        episodes: of each.
        seed: of the first episode of each.
        rng_seed: of the population.
    """
    population = random_rules(drivers, np.random.default_rng(rng_seed))
    env = make_env(SCENARIOS[scenario].id, OUR_ENVS)
    adapter = EnvAdapter(env)
    try:
        evaluations = evaluate_each(
            lambda rows: FunctionPolicy(RuleDrivers(population[rows]), adapter, gamma=GAMMA),
            drivers,
            env,
            episodes=episodes,
            seed=seed,
            gamma=GAMMA,
        )
    finally:
        env.close()
    return _conflicts(SCENARIOS[scenario].title, evaluations)


def find_rule_conflicts(*, rules: int, episodes: int, seed: int, rng_seed: int = 0) -> Conflicts:
    """The same of random :class:`GapRule` in LeftTurn."""
    rng = np.random.default_rng(rng_seed)
    drawn = [
        GapRule(
            gap=rng.uniform(0.0, 8.0),
            approach_speed=rng.uniform(1.5, 4.0),
            turn_speed=rng.uniform(2.5, 6.0),
            exit_speed=rng.uniform(2.5, 8.0),
            stop_distance=rng.uniform(0.3, 2.0),
        )
        for _ in range(rules)
    ]
    env_id = SCENARIOS["left_turn"].id
    evaluations = [evaluate(GapDriver(rule), env_id, episodes=episodes, seed=seed) for rule in drawn]
    return _conflicts("LeftTurn, fixed rules", evaluations)


def _conflicts(population: str, evaluations: Sequence[Evaluation]) -> Conflicts:
    objectives = evaluations[0].objectives
    returns = np.array([evaluation.returns[:, 0].mean(axis=0) for evaluation in evaluations])
    capable = np.array([evaluation.succeeded[:, 0].mean() for evaluation in evaluations]) >= ARRIVALS
    return Conflicts(population, objectives, int(capable.sum()), correlations(returns[capable], objectives))


def correlations(returns: Floats, objectives: Sequence[str]) -> dict[tuple[str, str], Estimate]:
    """Spearman's rank correlation of every two columns of ``returns`` (n, d), with intervals over the rows."""
    found = {}
    for (i, first), (k, second) in combinations(enumerate(objectives), 2):
        pair = returns[:, [i, k]]
        constant = len(pair) < LEAST_DRIVERS or (np.ptp(pair, axis=0) < 1e-9).any()
        found[first, second] = Estimate(np.nan) if constant else estimate(np.arange(len(pair)), _spearman(pair))
    return found


def _spearman(pairs: Floats) -> Callable[..., Any]:
    """Spearman's coefficient of the rows (..., m) of ``pairs`` (n, 2), as a statistic of the row numbers."""

    def coefficient(rows: NDArray[Any], axis: int = -1) -> Any:
        del axis  # the last one, which is the only one of the row numbers
        ranks = scipy.stats.rankdata(pairs[rows.astype(np.intp)], axis=-2)
        ranks -= ranks.mean(axis=-2, keepdims=True)
        x, y = ranks[..., 0], ranks[..., 1]
        size = np.sqrt((x * x).sum(axis=-1) * (y * y).sum(axis=-1))
        # Of a resample that is constant: 0.
        return (x * y).sum(axis=-1) / np.where(size > 0.0, size, np.inf)

    return coefficient


def write_conflicts(path: Path, conflicts: Sequence[Conflicts]) -> None:
    """Write a CSV with a row per population and pair of objectives.

    Raises:
        OSError: if the file cannot be written; it is complete or unchanged.
    """
    rows: list[list[Any]] = [["population", "drivers", "first", "second", "spearman", "low", "high"]]
    for each in conflicts:
        for (first, second), found in each.correlations.items():
            numbers = ["" if n is None or np.isnan(n) else round(n, 3) for n in (found.value, found.low, found.high)]
            rows.append([each.population, each.drivers, first, second, *numbers])
    atomic_write(path, csv_bytes(rows))


def plot_conflicts(path: Path, conflicts: Sequence[Conflicts], note: str) -> None:
    """Draw a matrix of correlations per population: red where two objectives conflict.

    Args:
        path: the image.
        conflicts: one per population.
        note: how they were found, below the title.

    Raises:
        OSError: if the file cannot be written.
    """
    with figure_style({"axes.grid": False, "axes.spines.left": False, "axes.spines.bottom": False}):
        figure = Figure(figsize=(3.9 * len(conflicts), 4.0))
        for axis, each in zip(np.atleast_1d(figure.subplots(1, len(conflicts))), conflicts, strict=True):
            d = len(each.objectives)
            matrix = np.full((d, d), np.nan)
            for (first, second), found in each.correlations.items():
                i, k = each.objectives.index(first), each.objectives.index(second)
                matrix[k, i] = found.value
                if np.isfinite(found.value):
                    colour = "white" if abs(found.value) > 0.6 else INK
                    axis.text(i, k, f"{found.value:+.2f}", ha="center", va="center", fontsize=8, color=colour)
            axis.imshow(matrix, cmap="RdBu", vmin=-1.0, vmax=1.0)
            names = [name_and_unit(objective)[0] for objective in each.objectives]
            axis.set_xticks(range(d - 1), names[:-1], rotation=45, ha="right")
            axis.set_yticks(range(1, d), names[1:])
            axis.set(xlim=(-0.5, d - 1.5), ylim=(d - 0.5, 0.5))
            axis.tick_params(length=0)
            axis.set_title(f"{each.population}: {each.drivers} drivers")
        surround(figure, "Which objectives conflict", [note])
        save_figure(figure, path)
