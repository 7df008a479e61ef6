"""What the explorer shows of a front, as compact JSON: numbers, drives and the command that evaluates a choice."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import moocore
import numpy as np

from mo_deepdrive.evaluation.drives import POSE, READINGS, Playback, record_scenes
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, find_spec, is_drivable, make_env
from mo_deepdrive.evaluation.front import best_known_front
from mo_deepdrive.evaluation.metrics import name_and_unit, without_vehicle
from mo_deepdrive.evaluation.statistics import rate
from mo_deepdrive.fronts import reference_fronts
from mo_deepdrive.simulation.state import ARRIVAL_RADIUS, LANE_WIDTH, LENGTH, MAP_CENTRE, WIDTH
from mo_deepdrive.utilities import COMFORT_BUDGETS, NONLINEAR, ComfortBudget
from mo_deepdrive.world.action_sequences import decode, discounted_sum, replay
from mo_deepdrive.world.objectives import signs
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from algorithms.agent import FrontAgent
    from mo_deepdrive.evaluation.drives import Drive, Scene
    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.front import Front
    from mo_deepdrive.world.config import EnvironmentSettings

BEST_KNOWN = "best-known/"  # before the name of a best-known front
SCENARIOS_SHOWN = 3  # of a front whose episodes differ
# Of the stored readings: whole multiples of this, as differences from decision to decision.
RESOLUTION = {"x": 0.01, "y": 0.01, "heading": 0.001, "speed": 0.01, "g_force": 0.001, "jerk": 0.01}
MAX_DRIVES = 4_000_000  # characters of all drives of a front; further scenarios are left out
MARGIN = 5.0  # m that the map shows around the drives


class DiscountedReturns(NamedTuple):
    """Returns (K, E, d) of a front's episodes with a discount factor, and the best-known ones (k, d)."""

    gamma: float
    returns: NDArray[np.float64]
    best_known: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class ExplorableFront:
    """A front of K policies with d objectives, all maximised, as the explorer shows it."""

    title: str
    objectives: tuple[str, ...]
    returns: NDArray[np.float64]  # (K, E, d) undiscounted, of E episodes of each policy
    scales: NDArray[np.float64]  # (d,) nominal, for algorithms.commands.choose.rank_policies
    signs: NDArray[np.float64]  # (d,) +1 or -1, by which a return is multiplied to get a magnitude
    success: NDArray[np.float64]  # (K,) share of the episodes that arrived; NaN where that is not known
    lengths: NDArray[np.float64]  # (K,) mean number of decisions
    command: str  # what evaluates a choice, with {preference} for "--weights ..." and so on, or with {policy}
    numbers: tuple[int, ...] = ()  # (K,) of the policies; from 0 on if empty
    note: str = ""  # how the numbers were measured, one sentence
    best_known: NDArray[np.float64] | None = None  # (k, d) undiscounted
    discounted: DiscountedReturns | None = None  # of the same episodes
    scenes: tuple[Scene, ...] = ()  # with K drives each, where they can be recorded
    budget_name: str = ""  # of the utility with a comfort budget for these objectives
    budget: ComfortBudget | None = None

    def to_json(self) -> dict[str, Any]:
        """The front as plain lists and numbers; returns and scales are exact, drives rounded to RESOLUTION."""
        kinds = [DiscountedReturns(1.0, self.returns, self.best_known), *([self.discounted] if self.discounted else [])]
        budget = self.budget
        return {
            "title": self.title,
            "objectives": [
                {"key": key, "name": name, "unit": unit, "scale": scale, "sign": sign}
                for key, scale, sign in zip(self.objectives, self.scales.tolist(), self.signs.tolist(), strict=True)
                for name, unit in [name_and_unit(key)]
            ],
            "returns": [
                {
                    "gamma": kind.gamma,
                    "episodes": kind.returns.tolist(),
                    "bestKnown": [] if kind.best_known is None else rounded(kind.best_known),
                }
                for kind in kinds
            ],
            "success": [None if np.isnan(share) else share for share in self.success.tolist()],
            "successRange": [self._success_range(share) for share in self.success.tolist()],
            "lengths": self.lengths.tolist(),
            "command": self.command,
            "numbers": list(self.numbers or range(len(self.success))),
            "note": self.note,
            "budget": budget
            and {
                "name": self.budget_name,
                "g_force": budget.g_force,
                "jerk": budget.jerk,
                "prices": dict(budget.prices),
                "gains": budget.GAINS,
                "excessPrices": dict(budget.excess_prices),
                "rule": _rule(budget),
            },
            "scenes": self._scenes_to_json(),
        }

    def _success_range(self, share: float) -> list[float] | None:
        """Wilson's interval of a share of the episodes; None where one episode says everything, or nothing."""
        episodes = self.returns.shape[1]
        if np.isnan(share) or episodes == 1:
            return None
        arrivals = rate(np.arange(episodes) < round(share * episodes))
        return [round(end, 3) for end in (arrivals.low, arrivals.high) if end is not None]

    def _scenes_to_json(self) -> list[dict[str, Any]]:
        """The first scenario, and those after it that fit into MAX_DRIVES."""
        stored = [scene_to_json(scene) for scene in self.scenes]
        sizes = np.cumsum([len(json.dumps(scene, separators=(",", ":"))) for scene in stored])
        return stored[: max(1, int((sizes <= MAX_DRIVES).sum()))]


def explorable_front(
    agent: FrontAgent,
    front: Front,
    evaluations: Sequence[Evaluation],
    environment: EnvironmentSettings,
    *,
    gamma: float,
    seed: int,
    title: str,
    command: str,
) -> ExplorableFront:
    """The front of a trained agent with new episodes of all its policies, from ``seed`` on, and drives in the first."""
    returns = np.stack([evaluation.joint_returns for evaluation in evaluations])
    discounted = np.stack([evaluation.joint_discounted for evaluation in evaluations])
    arrived = np.array([evaluation.joint_succeeded.mean() for evaluation in evaluations])
    with closing(make_env(environment.id, 1, environment.arguments)) as env:
        adapter = EnvAdapter(env)
        costs_are_negative = adapter.native and adapter.cost_sign == "maximise"
        best_known, best_discounted = best_known_front(env, 1.0), best_known_front(env, gamma)
    names = tuple(map(without_vehicle, front.objectives))
    budget_name, budget = _budget(find_spec(environment.id).kwargs.get("scenario"), front.objectives)
    driven = returns.shape[1]
    measured = f"{driven} episodes of each policy" if driven > 1 else "Every episode is the same, so one is driven"
    scenes: list[Scene] = []
    if is_drivable(environment.id):
        seeds = range(seed, seed + min(driven, SCENARIOS_SHOWN))
        conditions = np.tile(np.asarray(front.conditions, dtype=np.float32), (len(seeds), 1))
        policy = agent.policies(conditions)
        scenes = record_scenes(policy, environment.id, environment.arguments, seeds=seeds, drives=len(front))
    return ExplorableFront(
        title=title,
        objectives=front.objectives,
        returns=returns,
        scales=agent.front_scales,
        signs=signs(names) if costs_are_negative else np.ones(len(names)),
        success=np.where(np.isfinite(front.success), arrived, np.nan),
        lengths=np.array([evaluation.joint_lengths.mean() for evaluation in evaluations]),
        command=command,
        note=f"{measured}, from seed {seed} on.",
        best_known=best_known,
        discounted=DiscountedReturns(gamma, discounted, best_discounted) if gamma < 1.0 else None,
        scenes=tuple(scenes),
        budget_name=budget_name,
        budget=budget,
    )


def explorable_best_known(name: str) -> ExplorableFront:
    """A best-known front SCENARIO_ACTIONS, undiscounted and with the time among its objectives, with its drives."""
    scenario_name, _, action_type = name.rpartition("_")
    policies = reference_fronts.shipped(scenario_name, action_type)
    config = reference_fronts.front_config(scenario_name, action_type)
    scenario = SCENARIOS[scenario_name]
    objectives = (*scenario.objectives, reference_fronts.TIME)
    plans = [decode(policy.actions, action_type) for policy in policies]
    rewards = replay(config.model_copy(update={"objectives": objectives}), plans)
    returns = discounted_sum(rewards, 1.0)
    kept = np.flatnonzero(moocore.is_nondominated(returns, maximise=True))
    kept = kept[np.argsort(returns[kept, 0], kind="stable")]
    arguments = {
        "action_type": action_type,
        "fixed_destination": config.fixed_destination,
        "fixed_obstacle": config.fixed_obstacle,
        "objectives": list(objectives),
    }
    playback = Playback([plans[k] for k in kept], action_type)
    (scene,) = record_scenes(playback, scenario.id, arguments, seeds=[0], drives=len(kept))
    budget_name, budget = _budget(scenario_name, objectives)
    with closing(make_env(scenario.id, 1, arguments)) as env:
        scales = EnvAdapter(env).objective_scales.astype(np.float64)
    gamma = reference_fronts.GAMMA
    return ExplorableFront(
        title=f"best known: {scenario.title}, {action_type} actions",
        objectives=objectives,
        returns=returns[kept][:, None],
        scales=scales,
        signs=signs(objectives),
        success=np.array([float(drive.ends == ("arrived",)) for drive in scene.drives]),
        lengths=np.array([len(drive.readings) - 1.0 for drive in scene.drives]),
        command=f"mo_deepdrive.fronts.reference_fronts.shipped({scenario_name!r}, {action_type!r})[{{policy}}]",
        numbers=tuple(kept.tolist()),
        note="Returns of the stored action sequences; policies are not learnt, and nothing chooses them.",
        discounted=DiscountedReturns(gamma, discounted_sum(rewards, gamma)[kept][:, None]),
        scenes=(scene,),
        budget_name=budget_name,
        budget=budget,
    )


def _rule(budget: ComfortBudget) -> str:
    """What counts in a utility with a comfort budget, in words."""

    def priced(prices: Mapping[str, float]) -> list[str]:
        return [f"{name_and_unit(key)[0]} {price:g}" for key, price in prices.items()]

    costs = [f"{' and '.join(priced(budget.excess_prices))} beyond their budgets", *priced(budget.prices)]
    gains = ", ".join(priced(budget.GAINS))
    return f"It has the greatest expected utility. Gains per unit: {gains}. Costs per unit: {', '.join(costs)}."


def _budget(scenario: str | None, objectives: tuple[str, ...]) -> tuple[str, ComfortBudget | None]:
    """The utility with a comfort budget of a scenario and its numbers, if these objectives are enough for it."""
    name = f"{scenario}_comfort_budget"
    if name not in COMFORT_BUDGETS or not {*NONLINEAR[name][0]} <= {*objectives}:
        return "", None
    return name, COMFORT_BUDGETS[name]


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

    Readings of a vehicle are stored up to its end, poses of cars up to the last one; where a car is absent is None.
    """

    def series(columns: NDArray[np.float64], names: tuple[str, ...]) -> dict[str, list[int | None]]:
        return {name: _differences(columns[:, k] / RESOLUTION[name]) for k, name in enumerate(names)}

    return {
        "vehicles": [{**series(drive.readings[:, v], READINGS), "end": end} for v, end in enumerate(drive.ends)],
        "cars": [series(drive.cars[:, car], POSE) for car in range(drive.cars.shape[1])],
    }


def _differences(values: NDArray[np.float64]) -> list[int | None]:
    present = np.flatnonzero(np.isfinite(values))
    stored: list[int | None] = [None] * (int(present[-1]) + 1 if len(present) else 0)
    whole = np.rint(values[present]).astype(np.int64)
    for place, difference in zip(present.tolist(), np.diff(whole, prepend=0).tolist(), strict=True):
        stored[place] = difference
    return stored
