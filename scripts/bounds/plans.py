"""Plans: the sequences of actions that searches store, vary and evaluate, and random rules that drive instead of them.

A plan holds one action per decision of a whole episode and is the genome of a search. Plans of every action set are
int16 arrays (decisions, k), so that the same code mutates them: a discrete action is its index (k = 1), a continuous
one is steer, acceleration and brake (k = 3) in units of 1 / FULL_SCALE, the resolution of a front's file.

A rule waits, speeds up to a target speed and coasts or holds it, steers towards the next waypoint by proportional
control of the direction, at first off to a side, and slows down before it arrives. So a part of them collides and a
part arrives, quickly or calmly. Rules give the searches their first plans, and take over from some plans in the middle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from numpy.typing import NDArray

from algorithms.driving.controls import CURVATURE_PER_STEER, DRAG
from mo_deepdrive.fronts.reference_fronts import GAMMA, TIME
from mo_deepdrive.simulation import observation, traffic
from mo_deepdrive.simulation.actions import (
    CURL,
    DECAY,
    DECREASE,
    INCREASE,
    MAINTAIN,
    OFFSET,
    SPEED_CHANGE,
    decode_continuous,
    decode_discrete,
)
from mo_deepdrive.simulation.dynamics import make_scratch
from mo_deepdrive.simulation.kernel import rewarding, step_worlds
from mo_deepdrive.simulation.state import MAX_ACCELERATION, RUNNING, STEER_RANGE
from mo_deepdrive.world.action_sequences import CONTINUOUS_UNIT
from mo_deepdrive.world.action_sequences import idle as idle_action
from mo_deepdrive.world.actions import CONTINUOUS, action_table
from mo_deepdrive.world.batch import WorldBatch
from mo_deepdrive.world.observation import OWN, layout
from mo_deepdrive.world.scenarios import SCENARIOS
from scripts.bounds.variation import FULL_SCALE, make_offspring

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mo_deepdrive.world.config import EnvConfig

Plans = NDArray[np.int16]  # (n, decisions, k)


@dataclass(frozen=True)
class Criterion:
    """Which returns are maximised: of the scenario's objectives, and perhaps of the time.

    Without a discount nothing but the time tells a drive from the same after a wait.
    """

    gamma: float
    timed: bool = False

    def objectives(self, scenario: str) -> tuple[str, ...]:
        """The names of the d objectives."""
        return (*SCENARIOS[scenario].objectives, TIME) if self.timed else SCENARIOS[scenario].objectives

    def __str__(self) -> str:
        return f"{self.gamma}, time" if self.timed else str(self.gamma)


# A front is searched for all of them.
CRITERIA = (Criterion(GAMMA), Criterion(1.0), Criterion(1.0, timed=True))


class PlanFormat:
    """How the actions of one action set are stored in plans; ``table`` of a continuous one is (0, 4)."""

    def __init__(self, action_type: str, decisions: int):
        self.decisions = decisions
        self.continuous = action_type == CONTINUOUS
        idle = np.atleast_1d(idle_action(action_type))
        self.idle = (idle * FULL_SCALE if self.continuous else idle).astype(np.int16)
        self.table = np.zeros((0, 4)) if self.continuous else action_table(action_type)

    def idle_plans(self, n: int) -> Plans:
        """``n`` plans (n, decisions, k) that only idle."""
        return np.tile(self.idle, (n, self.decisions, 1))

    def from_sequences(self, sequences: Sequence[NDArray[Any]]) -> Plans:
        """Plans of sequences of environment actions, each (t,) or (t, 3) with t <= decisions; they idle afterwards."""
        plans = self.idle_plans(len(sequences))
        for plan, sequence in zip(plans, sequences, strict=True):
            plan[: len(sequence)] = np.rint(sequence * FULL_SCALE) if self.continuous else sequence[:, None]
        return plans

    def to_sequence(self, plan: NDArray[np.int16]) -> NDArray[Any]:
        """The environment actions (t,) or (t, 3) of a plan (decisions, k), without the idle actions at its end."""
        active = np.flatnonzero((plan != self.idle).any(axis=1))
        actions = plan[: active[-1] + 1 if len(active) else 0]
        return actions * CONTINUOUS_UNIT if self.continuous else actions[:, 0].astype(np.int64)


@dataclass(frozen=True)
class EvaluatedPlans:
    """n plans and the returns of their episodes."""

    plans: Plans  # (n, decisions, k) the actions; idle after the end of the episode
    lengths: NDArray[np.int64]  # (n,) decisions until the episode ended
    returns: tuple[NDArray[np.float64], ...]  # (n, d) returns for each of CRITERIA, maximised
    sources: NDArray[np.int64]  # (n,) index of what found the plan, in a list that the caller keeps

    def take(self, rows: NDArray[Any]) -> EvaluatedPlans:
        """The plans at ``rows``, in this order."""
        returns = tuple(each[rows] for each in self.returns)
        return EvaluatedPlans(self.plans[rows], self.lengths[rows], returns, self.sources[rows])

    def append(self, other: EvaluatedPlans) -> EvaluatedPlans:
        """These plans followed by those of ``other``, as a new object."""
        return EvaluatedPlans(
            np.concatenate([self.plans, other.plans]),
            np.concatenate([self.lengths, other.lengths]),
            tuple(np.concatenate(pair) for pair in zip(self.returns, other.returns, strict=True)),
            np.concatenate([self.sources, other.sources]),
        )


# ----------------------------------------------------------------------------------------------------- driving rules

_COLUMN = {entry.name: column for column, entry in enumerate(OWN)}
NEXT_ANGLE, AFTER_DISTANCE = _COLUMN["next_angle"], _COLUMN["after_distance"]
SPEED, STEER, THROTTLE = _COLUMN["speed"], _COLUMN["steer"], _COLUMN["throttle"]

RULE = np.dtype(
    [
        ("first_decision", np.int64),  # from which the rule drives
        ("wait", np.float64),  # s before it starts
        ("target_speed", np.float64),  # m/s
        ("speed_slack", np.float64),  # share of the target speed that may be lost before it speeds up again
        ("throttle", np.float64),  # while speeding up, of continuous actions (m/s^2)
        ("hold_speed", np.bool_),  # hold the target speed by throttle; else coast
        ("gain", np.float64),  # yaw rate (rad/s) per rad of direction error
        ("max_steer", np.float64),  # rad
        ("dead_zone", np.float64),  # direction error (rad) below which the wheel is straight
        ("detour", np.float64),  # rad by which it heads to a side at first, left is positive
        ("detour_time", np.float64),  # s of driving for which it does
        ("brake_distance", np.float64),  # m to the destination below which it slows down
    ]
)


def _log_uniform(low: float, high: float, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    return np.asarray(np.exp(rng.uniform(np.log(low), np.log(high), n)))


def random_rules(n: int, rng: np.random.Generator) -> NDArray[Any]:
    """``n`` random rules (n,) of RULE, which drive as fast as traffic does."""
    rules = np.zeros(n, dtype=RULE)
    rules["wait"] = np.where(rng.random(n) < 0.3, 0.0, rng.uniform(0.0, 20.0, n))
    rules["target_speed"] = _log_uniform(1.0, 10.0, n, rng)
    rules["speed_slack"] = rng.uniform(0.02, 0.5, n)
    rules["gain"] = _log_uniform(0.5, 4.0, n, rng)
    rules["dead_zone"] = np.where(rng.random(n) < 0.5, 0.0, _log_uniform(0.001, 0.1, n, rng))
    rules["detour"] = np.where(rng.random(n) < 0.3, 0.0, rng.uniform(-1.2, 1.2, n))
    rules["detour_time"] = rng.uniform(0.0, 8.0, n)
    rules["brake_distance"] = np.where(rng.random(n) < 0.5, 0.0, rng.uniform(0.0, 8.0, n))
    rules["max_steer"] = STEER_RANGE
    rules["throttle"] = MAX_ACCELERATION
    return rules


def random_calm_rules(n: int, rng: np.random.Generator) -> NDArray[Any]:
    """``n`` random rules (n,) of RULE that do not wait, and that may creep and steer or speed up but little."""
    rules = random_rules(n, rng)
    rules["wait"] = 0.0
    rules["target_speed"] = _log_uniform(0.02, 8.0, n, rng)
    rules["max_steer"] = _log_uniform(0.001, 0.3, n, rng)
    rules["throttle"] = _log_uniform(0.02, MAX_ACCELERATION, n, rng)
    rules["hold_speed"] = rng.random(n) < 0.5
    return rules


@numba.njit
def follow_rule(seen: NDArray[Any], rule: np.record, time: float, table: NDArray[Any], action: NDArray[Any]) -> None:
    """Write the action that a rule takes ``time`` s after the start into ``action`` (k,), in the format of plans."""
    driving = time - rule.wait
    error = -(np.float64(seen[NEXT_ANGLE]) - (rule.detour if driving < rule.detour_time else 0.0))
    speed = abs(np.float64(seen[SPEED]))
    steer = 0.0
    if abs(error) >= rule.dead_zone:
        steer = rule.gain * error / (CURVATURE_PER_STEER * max(speed, 0.3))
        steer = min(max(steer, -rule.max_steer), rule.max_steer)
    pushes = seen[THROTTLE] > 0.0
    target = rule.target_speed if driving >= 0.0 else 0.0
    faster = speed < target * (1.0 if pushes else 1.0 - rule.speed_slack)
    slower = np.float64(seen[AFTER_DISTANCE]) < rule.brake_distance and speed > 1.0
    if len(table) == 0:
        throttle = rule.throttle if faster else (DRAG * speed if rule.hold_speed else 0.0)
        action[0] = round(min(max(steer / STEER_RANGE, -1.0), 1.0) * FULL_SCALE)
        action[1] = 0 if slower else round(min(throttle / MAX_ACCELERATION, 1.0) * FULL_SCALE)
        action[2] = -FULL_SCALE // 2 if slower else -FULL_SCALE
        return
    change = MAINTAIN
    if slower:
        change = DECREASE
    elif faster:
        change = INCREASE
    elif pushes and not rule.hold_speed:
        change = DECREASE
    least = math.inf
    held = np.float64(seen[STEER])
    for row in range(len(table)):
        if table[row, SPEED_CHANGE] == change:
            offered = table[row, DECAY] * held + table[row, OFFSET] + table[row, CURL] / max(speed, 1.0) ** 2
            if abs(offered - steer) < least:
                least = abs(offered - steer)
                action[0] = row


# -------------------------------------------------------------------------------------------------------- evaluation


# Not cached on disk: Numba would not notice a change of the functions of other modules that it calls.
@numba.njit
def simulate_plans(
    worlds: NDArray[Any],
    plans: NDArray[Any],
    rules: Any,
    table: NDArray[Any],
    params: Any,
    motion: NDArray[Any],
    cars: NDArray[Any],
    path: NDArray[Any],
    sight: NDArray[Any],
    seen: NDArray[Any],
    controls: NDArray[Any],
    acted: NDArray[Any],
    rewards: NDArray[Any],
    write_rewards: Any,
    weights: NDArray[Any],
    returns: NDArray[Any],
    lengths: NDArray[Any],
) -> None:
    """Simulate one plan in each world until its episode ends, and write actions of rules, returns and lengths.

    ``worlds`` (n, 1) of VEHICLE are at their starts; ``weights`` (criteria, decisions) are the discounts of decisions,
    ``returns`` (criteria, n, d) and ``lengths`` (n,) decisions; what is between ``params`` and ``weights`` is scratch.
    """
    for i in range(len(worlds)):
        vehicle = worlds[i, 0]
        decision = params[0].dt * params[0].physics_steps
        for t in range(plans.shape[1]):
            if t >= rules[i].first_decision:
                observation.write(worlds, i, i + 1, 0, params[0], sight, seen)
                follow_rule(seen[i, 0], rules[i], t * decision, table, plans[i, t])
            if len(table):
                decode_discrete(worlds, i, 0, plans[i, t, 0], table, controls)
            else:
                steer, acceleration, brake = plans[i, t, 0], plans[i, t, 1], plans[i, t, 2]
                decode_continuous(i, 0, steer / FULL_SCALE, acceleration / FULL_SCALE, brake / FULL_SCALE, controls)
            step_worlds(worlds, i, i + 1, controls, params[0], motion, cars, path)
            write_rewards(worlds, i, params, acted, rewards)
            for g in range(len(weights)):
                for k in range(rewards.shape[2]):
                    returns[g, i, k] += weights[g, t] * rewards[i, 0, k]
            if vehicle.end != RUNNING:
                lengths[i] = t + 1
                break


class PlanEvaluator:
    """Evaluates plans of one vehicle from the start in ``batch``, at first that of an environment without draws."""

    def __init__(self, config: EnvConfig):
        self.batch = WorldBatch(config, 1)
        self.batch.place()
        self.format = PlanFormat(config.action_type, config.max_decisions)
        self.simulated_decisions = 0
        motion, path = make_scratch(1, config.physics_steps)
        self._scratch = (motion, traffic.make_scratch(0), path, np.zeros(1, dtype=observation.SIGHT))
        self._observed = len(layout(self.batch.scenario))
        self._weights = np.array([criterion.gamma ** np.arange(config.max_decisions) for criterion in CRITERIA])
        params = self.batch.params[0]
        # (criteria, decisions) the time until after each decision, discounted.
        self._times = self._weights.cumsum(axis=1) * (params["dt"] * params["physics_steps"])

    def evaluate(self, plans: Plans, source: int, rules: NDArray[Any] | None = None) -> EvaluatedPlans:
        """Simulate plans that ``source`` found, and write the actions of ``rules`` (n,) and idle ends into them."""
        n, d = len(plans), len(self.batch.objectives)
        if rules is None:
            rules = np.zeros(n, dtype=RULE)
            rules["first_decision"] = self.format.decisions
        returns = np.zeros((len(CRITERIA), n, d))
        lengths = np.zeros(n, dtype=np.int64)
        simulate_plans(
            np.repeat(self.batch.state, n, axis=0),
            plans,
            rules.view(np.recarray),
            self.format.table,
            self.batch.params,
            *self._scratch,
            np.zeros((n, 1, self._observed), dtype=np.float32),
            np.zeros((n, 1, 3)),
            np.ones((n, 1), dtype=np.bool_),
            np.zeros((n, 1, d), dtype=np.float32),
            rewarding(self.batch.measures),
            self._weights,
            returns,
            lengths,
        )
        for plan, length in zip(plans, lengths, strict=True):
            plan[length:] = self.format.idle
        self.simulated_decisions += int(lengths.sum())
        judged = tuple(
            np.column_stack([own, -times[lengths - 1]]) if criterion.timed else own
            for criterion, own, times in zip(CRITERIA, returns, self._times, strict=True)
        )
        return EvaluatedPlans(plans, lengths, judged, np.full(n, source))

    def offspring(
        self,
        plans: Plans,
        lengths: NDArray[np.int64],
        parents: NDArray[np.int64],
        mates: NDArray[np.int64],
        rng: np.random.Generator,
    ) -> Plans:
        """One child of each of the ``parents``, rows of ``plans``, perhaps crossed with its mate."""
        children, table = self.format.idle_plans(len(parents)), self.format.table
        make_offspring(
            plans[parents], lengths[parents], plans[mates], lengths[mates], children, len(table), self.format.idle, rng
        )
        return children

    def takeovers(self, lengths: NDArray[np.int64], rate: float, rng: np.random.Generator) -> NDArray[np.float64]:
        """From which decision on a rule drives instead of plans of these ``lengths``: in a share of ``rate``."""
        chosen = rng.random(len(lengths)) < rate
        return np.where(chosen, rng.random(len(lengths)) * lengths, self.format.decisions)
