"""What the explorer shows of a front, as compact JSON: numbers, drives and the command that evaluates a choice."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.evaluation.drives import POSE, READINGS
from mo_deepdrive.evaluation.metrics import name_and_unit
from mo_deepdrive.evaluation.statistics import rate
from mo_deepdrive.simulation.state import ARRIVAL_RADIUS, LANE_WIDTH, LENGTH, MAP_CENTRE, WIDTH

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from mo_deepdrive.evaluation.drives import Drive, Scene
    from mo_deepdrive.utilities import ComfortBudget

# Of the stored readings: whole multiples of this, as differences from decision to decision.
RESOLUTION = {"x": 0.01, "y": 0.01, "heading": 0.001, "speed": 0.01, "g_force": 0.001, "jerk": 0.01}
MAX_DRIVES = 4_000_000  # characters of all drives of a front; further scenarios are left out
MARGIN = 5.0  # m that the map shows around the drives


@dataclass(frozen=True)
class DiscountedReturns:
    """Returns of a front's episodes that the explorer shows instead of the undiscounted ones.

    Attributes:
        gamma: the discount factor, below 1.
        returns: (K, E, d) discounted returns of the episodes.
        best_known: (k, d) best-known returns with the same discount; None where there are none.
    """

    gamma: float
    returns: NDArray[np.float64]
    best_known: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class ExplorableFront:
    """A front of K policies with d objectives, all maximised, as the explorer shows it.

    Attributes:
        title: what the front belongs to.
        objectives: d names.
        returns: (K, E, d) undiscounted returns of E episodes of each policy.
        scales: (d,) nominal magnitudes of the returns, for :func:`mo_deepdrive.evaluation.choice.rank_policies`.
        signs: (d,) +1 or -1, by which a return is multiplied to get a magnitude.
        success: (K,) share of the episodes that arrived; NaN where that is not known.
        lengths: (K,) mean number of decisions.
        command: what evaluates the choice, with ``{preference}`` for "--weights ..." and so on, or ``{policy}`` for the
            number of the policy.
        numbers: (K,) numbers of the policies; from 0 on if empty.
        note: how the numbers were measured, one sentence.
        best_known: (k, d) best-known undiscounted returns; None where there are none.
        discounted: the returns of the same episodes with a discount factor; None where they are not known.
        scenes: scenarios, each with K drives; none for an environment whose drives cannot be recorded. Those that do
            not fit into MAX_DRIVES are not stored.
        budget_name: of the utility with a comfort budget for these objectives; "" for none.
        budget: its numbers; None for none.
    """

    title: str
    objectives: tuple[str, ...]
    returns: NDArray[np.float64]
    scales: NDArray[np.float64]
    signs: NDArray[np.float64]
    success: NDArray[np.float64]
    lengths: NDArray[np.float64]
    command: str
    numbers: tuple[int, ...] = ()
    note: str = ""
    best_known: NDArray[np.float64] | None = None
    discounted: DiscountedReturns | None = None
    scenes: tuple[Scene, ...] = ()
    budget_name: str = ""
    budget: ComfortBudget | None = None

    def __post_init__(self) -> None:
        k, d = len(self.success), len(self.objectives)
        if self.returns.ndim != 3 or self.returns.shape[::2] != (k, d) or len(self.lengths) != k:
            raise ValueError(f"returns have shape {self.returns.shape}; expected ({k}, episodes, {d})")
        if self.discounted is not None and self.discounted.returns.shape != self.returns.shape:
            raise ValueError(f"discounted returns have shape {self.discounted.returns.shape}, not {self.returns.shape}")
        for each in self._every_returns():
            if not np.isfinite(each.returns).all():
                raise ValueError("returns must be finite")
        for scene in self.scenes:
            if len(scene.drives) != k:
                raise ValueError(f"scenario {scene.seed} has {len(scene.drives)} drives for {k} policies")

    def _every_returns(self) -> list[DiscountedReturns]:
        """The undiscounted returns, and after them the discounted ones where they are known."""
        undiscounted = DiscountedReturns(1.0, self.returns, self.best_known)
        return [undiscounted] if self.discounted is None else [undiscounted, self.discounted]

    def to_json(self) -> dict[str, Any]:
        """The front as plain lists and numbers; returns and scales are exact, drives rounded to RESOLUTION."""
        named = [name_and_unit(name) for name in self.objectives]
        budget = self.budget
        return {
            "title": self.title,
            "objectives": [
                {"key": key, "name": name, "unit": unit, "scale": scale, "sign": sign}
                for key, (name, unit), scale, sign in zip(
                    self.objectives, named, self.scales.tolist(), self.signs.tolist(), strict=True
                )
            ],
            "returns": [
                {
                    "gamma": each.gamma,
                    "episodes": each.returns.tolist(),
                    "bestKnown": [] if each.best_known is None else rounded(each.best_known),
                }
                for each in self._every_returns()
            ],
            "success": [None if np.isnan(share) else share for share in self.success.tolist()],
            "successRange": [self._success_range(share) for share in self.success.tolist()],
            "lengths": self.lengths.tolist(),
            "command": self.command,
            "numbers": list(self.numbers or range(len(self.success))),
            "note": self.note,
            "budget": None
            if budget is None
            else {
                "name": self.budget_name,
                "g_force": budget.g_force,
                "jerk": budget.jerk,
                "prices": dict(budget.prices),
                "gains": budget.GAINS,
                "excessPrices": dict(budget.excess_prices),
            },
            "scenes": self._scenes_to_json(),
        }

    def _success_range(self, share: float) -> list[float] | None:
        """Wilson's interval of a share of the episodes; None where one episode says everything, or nothing."""
        episodes = self.returns.shape[1]
        if np.isnan(share) or episodes == 1:
            return None
        found = rate(np.arange(episodes) < round(share * episodes))
        interval: list[float] = rounded(np.array([found.low, found.high], dtype=np.float64), 3)
        return interval

    def _scenes_to_json(self) -> list[dict[str, Any]]:
        """The first scenario, and those after it that fit into MAX_DRIVES."""
        stored: list[dict[str, Any]] = []
        size = 0
        for scene in self.scenes:
            found = scene_to_json(scene)
            size += len(json.dumps(found, separators=(",", ":")))
            if stored and size > MAX_DRIVES:
                break
            stored.append(found)
        return stored


def rounded(values: ArrayLike, digits: int = 6) -> Any:
    """``values`` as nested lists of numbers with ``digits`` significant digits."""
    numbers = np.asarray(values, dtype=np.float64)
    return np.array([float(f"{value:.{digits}g}") for value in numbers.ravel()]).reshape(numbers.shape).tolist()


def scene_to_json(scene: Scene) -> dict[str, Any]:
    """A scenario and its drives as plain lists; lengths in metres."""
    return {
        "seed": scene.seed,
        "frequency": scene.decision_frequency,
        "lanes": scene.lanes,
        "roads": [
            {"line": rounded(road.line, 5), "width": road.width, "giveWay": rounded(road.give_way)}
            for road in scene.roads
        ],
        "centre": MAP_CENTRE,
        "box": rounded(scene.box(MARGIN)),
        "laneWidth": LANE_WIDTH,
        "arrivalRadius": ARRIVAL_RADIUS,
        "vehicle": [LENGTH, WIDTH],
        "routes": [rounded(route) for route in scene.routes],
        "obstacles": rounded(scene.obstacles),
        "resolution": RESOLUTION,
        "drives": [drive_to_json(drive) for drive in scene.drives],
    }


def drive_to_json(drive: Drive) -> dict[str, Any]:
    """A drive as whole numbers: every reading in units of RESOLUTION, first itself and then its differences.

    The sum of the first n + 1 numbers times the resolution is the reading after n decisions, rounded once. Readings of
    a vehicle are stored up to its end, poses of cars up to the last one; where a car is absent there is None.
    """
    return {
        "vehicles": [{**_series(drive.readings[:, v], READINGS), "end": end} for v, end in enumerate(drive.ends)],
        "cars": [_series(drive.cars[:, car], POSE) for car in range(drive.cars.shape[1])],
    }


def _series(columns: NDArray[np.float64], names: tuple[str, ...]) -> dict[str, list[int | None]]:
    return {name: _differences(columns[:, k] / RESOLUTION[name]) for k, name in enumerate(names)}


def _differences(values: NDArray[np.float64]) -> list[int | None]:
    present = np.flatnonzero(np.isfinite(values))
    stored: list[int | None] = [None] * (int(present[-1]) + 1 if len(present) else 0)
    whole = np.rint(values[present]).astype(np.int64)
    for place, difference in zip(present.tolist(), np.diff(whole, prepend=0).tolist(), strict=True):
        stored[place] = difference
    return stored
