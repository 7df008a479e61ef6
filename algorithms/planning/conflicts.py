"""Which objectives conflict: rank correlations of the returns over a population of drivers.

The population is the same in every scenario: random drivers that see the waypoints and their own motion alone. A driver
waits, speeds up to a target speed and coasts, steers towards the next waypoint, at first off to a side, and slows down
before it arrives. So a part of them collides and a part arrives, quickly or calmly. In LeftTurn there is a second
population, fixed rules that see the traffic (:mod:`algorithms.driving.left_turn_rules`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from matplotlib.figure import Figure

from algorithms.driving.left_turn_rules import GapDriver, GapRule
from algorithms.reporting.style import DIM, INK, TITLE_SIZE, figure_style, save_figure
from mo_deepdrive.actions import CURL, DECAY, DECREASE, INCREASE, MAINTAIN, OFFSET, SPEED_CHANGE, action_table
from mo_deepdrive.atomic_io import atomic_write, csv_bytes
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import OUR_ENVS, evaluate, evaluate_each
from mo_deepdrive.evaluation.function_policy import FunctionPolicy
from mo_deepdrive.evaluation.metrics import name_and_unit
from mo_deepdrive.evaluation.statistics import Estimate, estimate
from mo_deepdrive.observation import OWN
from mo_deepdrive.scenarios import SCENARIOS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.evaluation import Evaluation

    Floats = NDArray[np.float64]

COLUMN = {entry.name: column for column, entry in enumerate(OWN)}
YAW_PER_STEER = 8.4  # steady yaw rate (rad/s) per rad of steer and m/s
ARRIVALS = 0.25  # share of episodes in which a driver has to arrive to count
LEAST_DRIVERS = 10  # that a correlation needs
GAMMA = 0.99  # of the discount that tells the time

DRIVER = np.dtype(
    [
        ("wait", np.float64),  # s before it starts
        ("target_speed", np.float64),  # m/s
        ("speed_slack", np.float64),  # share of the target speed that may be lost before it speeds up again
        ("gain", np.float64),  # yaw rate (rad/s) per rad of direction error
        ("dead_zone", np.float64),  # direction error (rad) below which the wheel is straight
        ("detour", np.float64),  # rad by which it heads to a side at first, right is positive
        ("detour_time", np.float64),  # s of driving for which it does
        ("brake_distance", np.float64),  # m to the destination below which it slows down
    ]
)


def random_drivers(n: int, rng: np.random.Generator) -> NDArray[Any]:
    """``n`` random drivers (n,) of DRIVER."""
    drivers = np.zeros(n, dtype=DRIVER)

    def log_uniform(low: float, high: float) -> Floats:
        return np.asarray(np.exp(rng.uniform(np.log(low), np.log(high), n)))

    drivers["wait"] = np.where(rng.random(n) < 0.3, 0.0, rng.uniform(0.0, 20.0, n))
    drivers["target_speed"] = log_uniform(1.0, 10.0)
    drivers["speed_slack"] = rng.uniform(0.02, 0.5, n)
    drivers["gain"] = log_uniform(0.5, 4.0)
    drivers["dead_zone"] = np.where(rng.random(n) < 0.5, 0.0, log_uniform(0.001, 0.1))
    drivers["detour"] = np.where(rng.random(n) < 0.3, 0.0, rng.uniform(-1.2, 1.2, n))
    drivers["detour_time"] = rng.uniform(0.0, 8.0, n)
    drivers["brake_distance"] = np.where(rng.random(n) < 0.5, 0.0, rng.uniform(0.0, 8.0, n))
    return drivers


class RandomDrivers:
    """N random drivers as one policy of N episodes.

    A second vehicle is driven by the same driver, but does not wait.

    Args:
        drivers: (N,) of DRIVER.
        decision: seconds of a decision.
    """

    def __init__(self, drivers: NDArray[Any], decision: float = 0.1):
        self.drivers = drivers
        self.decision = decision
        self.table = action_table("discrete")

    def __call__(
        self, observations: NDArray[Any], _accrued: NDArray[Any], discounts: NDArray[Any]
    ) -> NDArray[np.int64]:
        """Actions (N,) or (N, V) for observations (N, size) or (N, V, size)."""
        seen = observations.astype(np.float64)
        drivers = self.drivers.reshape((-1,) + (1,) * (seen.ndim - 2))
        time = np.log(discounts) / np.log(GAMMA) * self.decision
        time[(slice(None), *([0] * (seen.ndim - 2)))] -= self.drivers["wait"]
        detour = np.where(time < drivers["detour_time"], drivers["detour"], 0.0)
        error = -(seen[..., COLUMN["next_angle"]] - detour)
        speed = np.abs(seen[..., COLUMN["speed"]])
        steer = np.where(
            np.abs(error) < drivers["dead_zone"],
            0.0,
            drivers["gain"] * error / (YAW_PER_STEER * np.maximum(speed, 0.3)),
        )
        pushes = seen[..., COLUMN["throttle"]] > 0.0
        target = np.where(time < 0.0, 0.0, drivers["target_speed"])
        close = (seen[..., COLUMN["after_distance"]] < drivers["brake_distance"]) & (speed > 1.0)
        faster = speed < target * np.where(pushes, 1.0, 1.0 - drivers["speed_slack"])
        change = np.where(close, DECREASE, np.where(faster, INCREASE, np.where(pushes, DECREASE, MAINTAIN)))
        offered = (
            self.table[:, DECAY] * seen[..., COLUMN["steer"], None]
            + self.table[:, OFFSET]
            + self.table[:, CURL] / np.maximum(speed, 1.0)[..., None] ** 2
        )
        fits = self.table[:, SPEED_CHANGE] == change[..., None]
        return np.asarray(np.where(fits, np.abs(offered - steer[..., None]), np.inf).argmin(axis=-1))


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
    population = random_drivers(drivers, np.random.default_rng(rng_seed))
    env = make_env(SCENARIOS[scenario].id, OUR_ENVS)
    adapter = EnvAdapter(env)
    try:
        evaluations = evaluate_each(
            lambda rows: FunctionPolicy(RandomDrivers(population[rows]), adapter, gamma=GAMMA),
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
        figure = Figure(figsize=(3.9 * len(conflicts), 4.6))
        figure.text(0.01, 0.985, "Which objectives conflict", fontsize=TITLE_SIZE, fontweight="bold", va="top")
        figure.text(0.01, 0.925, note, color=DIM, va="top")
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
        figure.tight_layout(rect=(0, 0, 1, 0.88))
        save_figure(figure, path)
