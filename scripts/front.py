"""Search a best-known front: drives of one scenario, the same in every episode, that no other known drive dominates.

    python scripts/front.py --scenario one_waypoint --action-type discrete --decisions 300000000 --seed 0
    python scripts/front.py --scenario static_obstacle --from RUN RUN ...

The search starts from the shipped front, from drives of trained runs and from random rules for driving. It goes on from
the drives that no other has dominated so far: their runs of equal actions are moved, changed, cut and crossed, or a
rule takes the wheel in the middle. Every drive is measured by the simulator. At the end those drives are kept that make
up most of the hypervolume, some for returns discounted with 0.99, some for undiscounted ones, and the shipped front is
replaced unless that makes it smaller. The same arguments, runs and shipped front give the same front.
"""

from __future__ import annotations

import argparse
import heapq
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import moocore
import numba
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from algorithms.common.accrued_reward import AccruedReward
from algorithms.common.atomic_io import atomic_write
from algorithms.common.env_adapter import EnvAdapter, make_env
from algorithms.evaluation.evaluate import Policy
from algorithms.experiments.build import build
from algorithms.experiments.config import find_environment
from algorithms.experiments.run_directory import Run
from algorithms.pcn import PCN
from mo_deepdrive import fronts
from mo_deepdrive.actions import (
    CURL,
    DECAY,
    DECREASE,
    IDLE,
    INCREASE,
    MAINTAIN,
    OFFSET,
    SPEED_CHANGE,
    action_table,
    decode_continuous,
    decode_discrete,
)
from mo_deepdrive.batch import WorldBatch
from mo_deepdrive.config import ActionType
from mo_deepdrive.objectives import scales
from mo_deepdrive.scenarios import DRAWS, SCENARIOS
from mo_deepdrive.simulation.dynamics import PATH_WIDTH
from mo_deepdrive.simulation.kernel import step_world
from mo_deepdrive.simulation.state import MAX_ACCELERATION, RUNNING, STEER_RANGE

GAMMAS = (fronts.GAMMA, 1.0)
KEPT = (200, 50)  # drives at most, and of them for the second of GAMMAS
UNITS = round(1 / fronts.CONTINUOUS_UNIT)
CHILDREN = 4096  # per generation
RULED = 5  # generations that rules drive from the start, before there are children
TAKEN_OVER = 0.1  # share of children that a rule takes over
BOX = 0.005  # of an objective's nominal scale: of the drives in one box the search goes on with one
QUICK = 60  # decisions; longer drives become parents less often, for they take longer, but not below RAREST
RAREST = 0.2
YAW_PER_STEER = 8.4  # rad/s that a car comes to turn by, per rad of steer and m/s
DRAG = 0.06  # m/s^2 that friction takes, per m/s
NO_SOURCE = -1

Plans = NDArray[np.int16]  # (n, decisions, k): a discrete action (k = 1), or a continuous one in units (k = 3)


@dataclass(frozen=True)
class Drives:
    """n drives.

    Attributes:
        plans: (n, decisions, k) their actions, idle after the end.
        lengths: (n,) decisions until the episode ended.
        returns: (gammas, n, d) for each of GAMMAS, maximised.
        sources: (n,) indices of what found them.
    """

    plans: Plans
    lengths: NDArray[np.int64]
    returns: NDArray[np.float64]
    sources: NDArray[np.int64]

    def take(self, rows: NDArray[Any]) -> Drives:
        return Drives(self.plans[rows], self.lengths[rows], self.returns[:, rows], self.sources[rows])

    def __add__(self, other: Drives) -> Drives:
        return Drives(
            np.concatenate([self.plans, other.plans]),
            np.concatenate([self.lengths, other.lengths]),
            np.concatenate([self.returns, other.returns], axis=1),
            np.concatenate([self.sources, other.sources]),
        )


# -------------------------------------------------------------------------------------------------- driving by rule


# Rules for driving: by a point on the way to the destination, up to a speed, and then coasting or holding it.
PILOT = np.dtype(
    [
        ("since", np.int64),  # decision from which the rule drives
        ("via_x", np.float64),  # a point on the way (m)
        ("via_y", np.float64),
        ("near", np.float64),  # how close it is passed (m)
        ("gain", np.float64),  # rad/s of turning per rad of direction
        ("largest", np.float64),  # steer (rad)
        ("dead", np.float64),  # direction (rad) below which the wheel stays straight
        ("speed", np.float64),  # that it speeds up to (m/s)
        ("slack", np.float64),  # share of the speed that may be lost before it speeds up again
        ("throttle", np.float64),  # while it speeds up (m/s^2)
        ("hold", np.bool_),  # whether it holds the speed by throttle, not coasts
        ("brake", np.float64),  # distance to the destination (m) below which it slows down
    ]
)


def random_pilots(n: int, rng: np.random.Generator, batch: WorldBatch) -> NDArray[Any]:
    """n random rules for the scenario that is placed in the first world of ``simulator``."""

    def spread(low: float, high: float) -> NDArray[np.float64]:
        return np.exp(rng.uniform(np.log(low), np.log(high), n))

    car, blocked = batch.state[0, 0], batch.scenario.obstacle
    middle = car["obstacle"].mean(axis=0) if blocked else (car["waypoints"][0] + (car["x"], car["y"])) / 2
    via = middle + rng.normal(0.0, 4.0, (n, 2))
    direct = rng.random(n) < (0.1 if blocked else 0.7)
    pilots = np.zeros(n, dtype=PILOT)
    pilots["via_x"], pilots["via_y"] = via.T
    pilots["near"] = np.where(direct, np.inf, rng.uniform(1.0, 5.0, n))
    pilots["gain"] = spread(0.2, 4.0)
    pilots["largest"] = spread(0.001, 0.3)
    pilots["dead"] = np.where(rng.random(n) < 0.5, 0.0, spread(0.001, 0.3))
    pilots["speed"] = spread(0.02, 8.0)
    pilots["slack"] = np.where(rng.random(n) < 0.5, 0.02, rng.uniform(0.0, 0.8, n))
    pilots["throttle"] = spread(0.02, MAX_ACCELERATION)
    pilots["hold"] = rng.random(n) < 0.5
    pilots["brake"] = np.where(rng.random(n) < 0.7, 0.0, rng.uniform(0.0, 8.0, n))
    return pilots


@numba.njit
def follow_rule(vehicle, pilot, passed, table, action):
    """Write into ``action`` (k,) what a rule does; True once the point on the way lies behind."""
    goal_x = pilot.via_x - vehicle.front_x
    goal_y = pilot.via_y - vehicle.front_y
    if passed or math.hypot(goal_x, goal_y) < pilot.near:
        passed = True
        goal_x = vehicle.waypoints[0, 0] - vehicle.front_x
        goal_y = vehicle.waypoints[0, 1] - vehicle.front_y
    ahead = goal_y * vehicle.cos_heading - goal_x * vehicle.sin_heading
    angle = math.atan2(-goal_x * vehicle.cos_heading - goal_y * vehicle.sin_heading, ahead)
    speed = abs(vehicle.speed)
    steer = 0.0
    if abs(angle) >= pilot.dead:
        steer = pilot.gain * angle / (YAW_PER_STEER * max(speed, 0.3))
        steer = min(max(steer, -pilot.largest), pilot.largest)
    wanted = pilot.speed if vehicle.throttle > 0.0 else pilot.speed * (1.0 - pilot.slack)
    faster = speed < wanted
    slower = vehicle.next_distance < pilot.brake and speed > 0.3
    if len(table) == 0:
        throttle = pilot.throttle if faster else (DRAG * speed if pilot.hold else 0.0)
        action[0] = round(min(max(steer / STEER_RANGE, -1.0), 1.0) * UNITS)
        action[1] = 0 if slower else round(min(throttle / MAX_ACCELERATION, 1.0) * UNITS)
        action[2] = -UNITS // 2 if slower else -UNITS
        return passed
    change = MAINTAIN
    if slower:
        change = DECREASE
    elif faster:
        change = INCREASE
    elif vehicle.throttle > 0.0 and not pilot.hold:
        change = IDLE  # which lets the throttle go, and the wheel
    action[0] = 0
    best = math.inf
    for row in range(1, len(table)):
        if table[row, SPEED_CHANGE] == change:
            offered = table[row, DECAY] * vehicle.steer + table[row, OFFSET] + table[row, CURL] / max(speed, 1.0) ** 2
            if abs(offered - steer) < best:
                best = abs(offered - steer)
                action[0] = row
    return passed


@numba.njit
def drive_worlds(worlds, plans, pilots, table, params, path, controls, discrete, continuous, weights, returns, lengths):
    """Drive one plan in each world until its episode ends.

    Args:
        worlds: (n, 1) of VEHICLE at their starts, changed in place.
        plans: (n, decisions, k) int16; what a rule does is written.
        pilots: (n,) of PILOT.
        table: of the discrete actions, empty for continuous ones.
        params: (1,) of PARAMS.
        path, controls, discrete, continuous: scratch: path of one world, (n, 1, 3), (1, 1) integers, (1, 1, 3).
        weights: (gammas, decisions) discount of each decision.
        returns: (gammas, n, d), added to.
        lengths: (n,), written.
    """
    for i in range(len(worlds)):
        vehicle = worlds[i, 0]
        passed = False
        for t in range(plans.shape[1]):
            if t >= pilots[i].since:
                passed = follow_rule(vehicle, pilots[i], passed, table, plans[i, t])
            if len(table):
                discrete[0, 0] = plans[i, t, 0]
                decode_discrete(worlds[i : i + 1], discrete, table, controls[i : i + 1])
            else:
                for axis in range(3):
                    continuous[0, 0, axis] = plans[i, t, axis] / UNITS
                decode_continuous(continuous, controls[i : i + 1])
            step_world(worlds, i, controls, params[0], path)
            for k in range(params[0].n_objectives):
                value = params[0].objective_sign[k] * vehicle.objectives[params[0].objective_index[k]]
                for g in range(len(weights)):
                    returns[g, i, k] += weights[g, t] * np.float32(value)
            if vehicle.end != RUNNING:
                lengths[i] = t + 1
                break


class Driver:
    """Drives sequences of actions and rules, in the compiled kernel."""

    def __init__(self, scenario: str, action_type: str):
        config = fronts.front_config(scenario, action_type)
        self.batch = WorldBatch(config, 1)
        self.batch.place(np.arange(1), lambda rows: np.zeros((len(rows), DRAWS)))
        self.continuous = self.batch.continuous
        self.decisions = config.max_decisions
        self.driven = 0
        idle = np.atleast_1d(fronts.idle(action_type))
        self.idle = (idle * UNITS if self.continuous else idle).astype(np.int16)
        self.table = np.zeros((0, 4)) if self.continuous else action_table(action_type)
        self._path = np.zeros((1, config.physics_steps + 1, PATH_WIDTH))
        self._weights = np.array([gamma ** np.arange(self.decisions) for gamma in GAMMAS])

    def blank(self, n: int) -> Plans:
        """n plans that idle."""
        return np.tile(self.idle, (n, self.decisions, 1))

    def plans(self, sequences: Sequence[NDArray[Any]]) -> Plans:
        """Plans of sequences as environments take them, (decisions,) or (decisions, 3)."""
        plans = self.blank(len(sequences))
        for plan, sequence in zip(plans, sequences, strict=True):
            plan[: len(sequence)] = np.rint(sequence * UNITS) if self.continuous else sequence[:, None]
        return plans

    def sequence(self, plan: Plans) -> NDArray[Any]:
        """A plan (decisions, k) as `fronts.encode` takes it, without the idling at its end."""
        busy = np.flatnonzero((plan != self.idle).any(axis=1))
        kept = plan[: busy[-1] + 1 if len(busy) else 0]
        return kept * fronts.CONTINUOUS_UNIT if self.continuous else kept[:, 0].astype(np.int64)

    def drive(self, plans: Plans, source: int, pilots: NDArray[Any] | None = None) -> Drives:
        """Drive ``plans``, changed in place, and ``pilots`` (n,) from the decision on that each names."""
        n, d = len(plans), len(self.batch.objectives)
        if pilots is None:
            pilots = np.zeros(n, dtype=PILOT)
            pilots["since"] = self.decisions
        returns = np.zeros((len(GAMMAS), n, d))
        lengths = np.zeros(n, dtype=np.int64)
        drive_worlds(
            np.repeat(self.batch.state, n, axis=0),
            plans,
            pilots.view(np.recarray),
            self.table,
            self.batch.params,
            self._path,
            np.zeros((n, 1, 3)),
            np.zeros((1, 1), dtype=np.int64),
            np.zeros((1, 1, 3)),
            self._weights,
            returns,
            lengths,
        )
        for plan, length in zip(plans, lengths, strict=True):
            plan[length:] = self.idle
        self.driven += int(lengths.sum())
        return Drives(plans, lengths, returns, np.full(n, source))


# ------------------------------------------------------------------------------------------------ new plans from old


@numba.njit(cache=True)
def splice(plan, size, first, last, room):
    """Make the decisions [first, last) of a plan of ``size`` decisions ``room`` long; its new size."""
    new = min(size + room - (last - first), len(plan))
    end = min(first + room, new)
    if end > last:
        for t in range(new - 1, end - 1, -1):
            plan[t] = plan[t - end + last]
    else:
        for t in range(end, new):
            plan[t] = plan[t - end + last]
    return new


@numba.njit(cache=True)
def amount(rng):
    """A number of decisions: mostly few, at least one."""
    return int(rng.geometric(0.35)) * (8 if rng.random() < 0.1 else 1)


@numba.njit(cache=True)
def change_action(action, n_actions, rng):
    """Change an action (k,) in place: its steer or its speed; now and then all of it."""
    kind = rng.random()
    if n_actions:
        steer, speed = (action[0] - 1) // 3, (action[0] - 1) % 3
        if action[0] == 0 or kind < 0.15:
            action[0] = rng.integers(0, n_actions)
        elif kind < 0.2:
            action[0] = 0
        elif kind < 0.6:
            action[0] = 1 + 3 * rng.integers(0, n_actions // 3) + speed
        else:
            action[0] = 1 + 3 * steer + rng.integers(0, 3)
        return
    axis = 0 if kind < 0.5 else 1 if kind < 0.95 else 2
    if rng.random() < 0.1:
        action[axis] = -UNITS if axis == 2 else 0
    else:
        by = rng.normal(0.0, math.exp(rng.uniform(0.0, math.log(0.3 * UNITS))))
        action[axis] = min(max(round(action[axis] + by), -UNITS), UNITS)


@numba.njit(cache=True)
def mutate(plan, size, n_actions, idle, rng):
    """Change one thing about a plan of ``size`` decisions, in place; its new size."""
    if size == 0:
        plan[0] = idle
        size = 1
    # A run of equal actions, [first, last).
    first = rng.integers(0, size)
    last = first + 1
    while first > 0 and (plan[first - 1] == plan[first]).all():
        first -= 1
    while last < size and (plan[last] == plan[first]).all():
        last += 1
    kind = rng.random()
    by = amount(rng)
    if kind < 0.3:  # it ends later or earlier, and what follows moves along or gives way
        grows = rng.random() < 0.5
        moves = rng.random() < 0.4
        if grows:
            size = splice(plan, size, last, last if moves else min(last + by, size), by)
            for t in range(last, min(last + by, size)):
                plan[t] = plan[first]
        elif moves or last == size:
            size = splice(plan, size, max(last - by, first), last, 0)
        else:
            for t in range(max(last - by, first), last):
                plan[t] = plan[last]
    elif kind < 0.55:  # another action
        change_action(plan[first], n_actions, rng)
        for t in range(first + 1, last):
            plan[t] = plan[first]
    elif kind < 0.7:  # another action in a part of it
        first = rng.integers(first, last)
        change_action(plan[first], n_actions, rng)
        for t in range(first + 1, min(first + by, last)):
            plan[t] = plan[first]
    elif kind < 0.8:  # another action before it
        size = splice(plan, size, first, first, by)
        change_action(plan[first], n_actions, rng)
        for t in range(first + 1, min(first + by, size)):
            plan[t] = plan[first]
    elif kind < 0.9:  # without it, and what follows moves along or fills the gap
        if last == size or rng.random() < 0.4:
            size = splice(plan, size, first, last, 0)
        else:
            for t in range(first, last):
                plan[t] = plan[last]
    elif kind < 0.95:  # waiting before all else
        size = splice(plan, size, 0, 0, by)
        for t in range(min(by, size)):
            plan[t] = idle
    else:  # from here to somewhere slower or faster; gentler or harder if that can be
        last = rng.integers(first, size) + 1
        factor = math.exp(rng.normal(0.0, 0.15))
        if n_actions or rng.random() < 0.5:
            old = plan[first:last].copy()
            room = max(round(factor * (last - first)), 1)
            size = splice(plan, size, first, last, room)
            for t in range(first, min(first + room, size)):
                plan[t] = old[min(int((t - first) / factor), len(old) - 1)]
        else:
            axis = rng.integers(0, 2)
            for t in range(first, last):
                plan[t, axis] = min(max(round(plan[t, axis] * factor), -UNITS), UNITS)
    return size


@numba.njit(cache=True)
def breed(parents, lengths, mates, mate_lengths, plans, n_actions, idle, rng):
    """Write a child of each parent, now and then crossed with its mate, into ``plans``, which idle.

    Args:
        parents, mates: (n, decisions, k).
        lengths, mate_lengths: (n,).
        plans: (n, decisions, k), written.
        n_actions: of a discrete set; 0 for continuous ones.
        idle: (k,) the action that does nothing.
        rng: a NumPy generator.
    """
    for i in range(len(plans)):
        plan = plans[i]
        size = lengths[i]
        plan[:size] = parents[i, :size]
        crossed = rng.random() < 0.15
        if crossed:
            cut = rng.integers(0, size + 1)
            join = min(max(cut + rng.integers(-5, 6), 0), mate_lengths[i])
            rest = min(mate_lengths[i] - join, len(plan) - cut)
            plan[cut : cut + rest] = mates[i, join : join + rest]
            size = cut + rest
        goes_on = not crossed or rng.random() < 0.5
        while goes_on:
            size = mutate(plan, size, n_actions, idle, rng)
            goes_on = rng.random() < 0.5
        for t in range(size, len(plan)):
            plan[t] = idle


# --------------------------------------------------------------------------------------------------- what is kept


def hypervolume(returns: NDArray[Any], reference: NDArray[Any]) -> float:
    return float(moocore.hypervolume(returns, ref=reference, maximise=True))


def best_of_boxes(drives: Drives, names: tuple[str, ...]) -> NDArray[np.int64]:
    """For each of GAMMAS, the rows of the best drive of every box of returns that no other box dominates."""
    kept = []
    for returns in drives.returns:
        scaled = returns / scales(names)
        boxes = np.floor(scaled / BOX)
        order = np.lexsort((drives.lengths, -scaled.sum(axis=1)))
        _, first = np.unique(boxes[order], axis=0, return_index=True)
        rows = order[first]
        kept.append(rows[moocore.is_nondominated(boxes[rows], maximise=True)])
    return np.unique(np.concatenate(kept))


def largest_subset(returns: NDArray[Any], reference: NDArray[Any], size: int) -> list[int]:
    """At most ``size`` rows of ``returns``, each chosen because it adds most hypervolume to those chosen before."""
    chosen: list[int] = []
    volume = 0.0
    queue = [(-hypervolume(returns[[row]], reference), row, 0) for row in range(len(returns))]
    heapq.heapify(queue)
    while queue and len(chosen) < size:
        loss, row, chosen_then = heapq.heappop(queue)
        if loss >= 0.0:
            break
        if chosen_then == len(chosen):
            chosen.append(row)
            volume -= loss
        else:
            # What a drive adds only shrinks as others are chosen: one that leads with an up-to-date figure is next.
            loss = volume - hypervolume(returns[[*chosen, row]], reference)
            heapq.heappush(queue, (loss, row, len(chosen)))
    return chosen


def chosen_few(drives: Drives, references: Sequence[NDArray[Any]]) -> Drives:
    """At most KEPT drives: the best of each objective, and those that make up most of the hypervolume.

    Only drives that dominate the reference points of all GAMMAS count. They are ordered by falling discounted distance.
    """
    drives = drives.take(np.flatnonzero((drives.returns >= np.array(references)[:, None]).all(axis=(0, 2))))
    rows: set[int] = set()
    for returns, reference, size in zip(drives.returns[::-1], references[::-1], KEPT[::-1], strict=True):
        front = np.flatnonzero(moocore.is_nondominated(returns, maximise=True))
        rows |= set(front[returns[front].argmax(axis=0)].tolist())
        for row in front[largest_subset(returns[front], reference, size)].tolist():
            if len(rows) < size:
                rows.add(row)
    few = drives.take(np.array(sorted(rows)))
    return few.take(np.lexsort(few.returns[0].T[::-1])[::-1])


# ------------------------------------------------------------------------------------------------------- the search


class Search:
    """A search of the front of one scenario and action set.

    Args:
        scenario, action_type: whose.
        seed: of all random choices.
    """

    def __init__(self, scenario: str, action_type: str, seed: int):
        self.names = SCENARIOS[scenario].objectives
        self.references = [fronts.reference_point(scenario, action_type, gamma).values for gamma in GAMMAS]
        self.driver = Driver(scenario, action_type)
        self.rng = np.random.default_rng(seed)
        self.generations = 0
        self.archive = self.driver.drive(self.driver.blank(1), NO_SOURCE)

    def add(self, drives: Drives) -> None:
        """Keep the best of the archive and ``drives``."""
        both = self.archive + drives
        self.archive = both.take(best_of_boxes(both, self.names))

    def generation(self, source: int) -> None:
        """Drive new plans; ``source`` is the index of what found them."""
        pilots = random_pilots(CHILDREN, self.rng, self.driver.batch)
        if self.generations < RULED:
            plans = self.driver.blank(CHILDREN)
        else:
            parents, mates = self._pick(), self._pick()
            n = min(len(parents), len(mates))
            parents, mates, pilots = parents[:n], mates[:n], pilots[:n]
            plans = self.driver.blank(n)
            old = self.archive
            breed(
                old.plans[parents],
                old.lengths[parents],
                old.plans[mates],
                old.lengths[mates],
                plans,
                len(self.driver.table),
                self.driver.idle,
                self.rng,
            )
            taken_over = self.rng.random(n) < TAKEN_OVER
            pilots["since"] = np.where(taken_over, self.rng.random(n) * old.lengths[parents], self.driver.decisions)
        self.generations += 1
        self.add(self.driver.drive(plans, source, pilots))

    def _pick(self) -> NDArray[np.int64]:
        """Rows of the archive, those of long drives less often."""
        rows = self.rng.integers(len(self.archive.lengths), size=CHILDREN)
        return rows[self.rng.random(CHILDREN) < np.maximum(QUICK / self.archive.lengths[rows], RAREST)]

    def volumes(self, drives: Drives) -> list[float]:
        """The hypervolume of drives for each of GAMMAS."""
        return [hypervolume(*each) for each in zip(drives.returns, self.references, strict=True)]


# ------------------------------------------------------------------------------------------------ drives of runs


def drives_of_run(path: str, scenario: str, action_type: str, episodes: int) -> tuple[str, str, list[NDArray[Any]]]:
    """The name of a run, what it is, and what its policies do in the scenario of a front, greedily and sampled.

    Raises:
        ValueError: if there is no such run, or it is of another scenario or action set.
    """
    run = Run.open(path)
    settings = run.experiment.environment
    for name, expected, found in (
        ("scenario", scenario, find_environment(settings.id).kwargs.get("scenario")),
        ("action_type", action_type, settings.arguments.get("action_type", "discrete")),
    ):
        if found != expected:
            raise ValueError(f"run {path!r} has {name} = {found!r}; the front needs {expected!r}")
    agent = build(run.experiment, num_envs=1)
    agent.load(run.checkpoint, policy_only=True)
    config = fronts.front_config(scenario, action_type).model_dump(mode="json", exclude={"scenario"})
    emitted: dict[str, Any] = {
        name: settings.arguments[name] for name in ("objectives", "cost_sign") if name in settings.arguments
    }
    sequences = []
    for sampled in (False, True):
        times = episodes if sampled else 1
        policy: Policy = agent
        count = times
        if isinstance(agent, PCN):
            desired, horizon = agent.commands()
            policy = agent.commanded(np.repeat(desired, times, axis=0), np.repeat(horizon, times))
            count = times * len(horizon)
        if count:
            worlds = EnvAdapter(make_env(settings.id, count, {**config, **emitted}))
            sequences += record(policy, worlds, torch.Generator(agent.device).manual_seed(0) if sampled else None)
    training = run.experiment.training
    about = f"{run.experiment.algorithm['name']}, seed {training.seed}, {training.total_timesteps} steps"
    return "/".join(run.path.absolute().parts[-3:]), about, sequences


def record(policy: Policy, worlds: EnvAdapter, generator: torch.Generator | None) -> list[NDArray[Any]]:
    """The actions of one episode per world, as the environment takes them."""
    observations = worlds.reset(0)
    accrued_reward = AccruedReward.begin(worlds.num_envs, 1, len(worlds.objectives))
    lengths = np.zeros(worlds.num_envs, dtype=np.int64)
    taken = []
    while not lengths.all():
        actions = policy.act(observations, accrued_reward, generator)
        taken.append(worlds.environment_actions(actions))
        step = worlds.step(actions)
        accrued_reward.add(step.rewards, policy.gamma)
        lengths[(lengths == 0) & (step.terminated | step.truncated)[:, 0]] = len(taken)
        observations = step.observations
    return [np.stack(taken)[:length, row] for row, length in enumerate(lengths)]


# ------------------------------------------------------------------------------------------------ the command line


def front_file(scenario: str, action_type: str) -> Path:
    """Where a front is shipped."""
    return Path(fronts.__file__).parent / "data" / f"front_{scenario}_{action_type}.json"


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of this script."""
    open_roads = [name for name, scenario in SCENARIOS.items() if not scenario.lanes]
    parser = argparse.ArgumentParser(description="Search a best-known front.", allow_abbrev=False)
    parser.add_argument("--scenario", choices=open_roads, default="one_waypoint", help="(default: %(default)s)")
    parser.add_argument(
        "--action-type", choices=get_args(ActionType), default="discrete", help="(default: %(default)s)"
    )
    parser.add_argument(
        "--decisions", type=int, default=300_000_000, metavar="N", help="to simulate (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the search (default: %(default)s)")
    parser.add_argument("--anew", action="store_true", help="do not start from the shipped front")
    parser.add_argument("--from", dest="runs", nargs="+", default=[], metavar="RUN", help="also start from these runs")
    parser.add_argument(
        "--episodes",
        type=int,
        default=8,
        metavar="N",
        help="sampled ones of each policy of a run (default: %(default)s)",
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="write here instead of replacing the shipped front")
    options = parser.parse_args(arguments)
    for name, least in (("decisions", 0), ("seed", 0), ("episodes", 0)):
        if getattr(options, name) < least:
            parser.error(f"--{name} {getattr(options, name)} must be at least {least}")
    if options.output is not None and not options.output.absolute().parent.is_dir():
        parser.error(f"--output {options.output}: there is no folder {options.output.absolute().parent}")
    return options


def command(options: argparse.Namespace, runs: Sequence[str]) -> str:
    """The command line that finds the same drives."""
    parts = [f"--scenario {options.scenario} --action-type {options.action_type}"]
    parts.append(f"--decisions {options.decisions} --seed {options.seed}")
    parts += ["--anew"] if options.anew else []
    parts += [f"--from {' '.join(runs)} --episodes {options.episodes}"] if runs else []
    return f"python scripts/front.py {' '.join(parts)}"


def report(search: Search, before: Drives, after: Drives, console: Console) -> None:
    """Print the hypervolumes and sizes of two fronts."""
    table = Table("gamma", "policies before", "after", "hypervolume before", "after", "change")
    for k, volumes in enumerate(zip(search.volumes(before), search.volumes(after), strict=True)):
        sizes = [int(moocore.is_nondominated(each.returns[k], maximise=True).sum()) for each in (before, after)]
        change = f"{volumes[1] / volumes[0] - 1.0:+.3%}" if volumes[0] else "-"
        table.add_row(f"{GAMMAS[k]}", *map(str, sizes), *(f"{volume:.6g}" for volume in volumes), change)
    console.print(table)


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = parse_arguments(arguments)
    scenario, action_type = options.scenario, options.action_type
    console = Console(width=120)
    file = front_file(scenario, action_type)
    search = Search(scenario, action_type, options.seed)
    driver = search.driver

    policies = fronts.read(file.read_text(encoding="utf-8")) if file.is_file() else ()
    sources = [policy.source for policy in policies]
    known = [fronts.decode(policy.actions, action_type) for policy in policies]
    shipped = driver.drive(driver.plans(known), NO_SOURCE)
    shipped.sources[:] = np.arange(len(policies))
    start = shipped.take(np.arange(0)) if options.anew else shipped
    names = []
    try:
        for path in options.runs:
            name, about, sequences = drives_of_run(path, scenario, action_type, options.episodes)
            start += driver.drive(driver.plans(sequences), len(sources))
            sources.append(f"run {name}: {about}")
            names.append(name)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    search.add(start)
    sources.append(command(options, names))
    search.archive.sources[search.archive.sources == NO_SOURCE] = len(sources) - 1
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("searching", total=options.decisions)
        driver.driven = 0
        while driver.driven < options.decisions:
            search.generation(len(sources) - 1)
            progress.update(task, completed=driver.driven)

    found = chosen_few(search.archive + start, search.references)
    report(search, shipped, found, console)
    if options.output is None and any(
        new < old for new, old in zip(search.volumes(found), search.volumes(shipped), strict=True)
    ):
        console.print("The shipped front is larger; nothing is written.")
        return 0
    rows = zip(found.plans, *np.round(found.returns[::-1], 6).tolist(), found.sources, strict=True)
    text = fronts.write(
        scenario,
        action_type,
        [
            fronts.KnownPolicy(fronts.encode(driver.sequence(plan)), tuple(total), tuple(discounted), sources[source])
            for plan, total, discounted, source in rows
        ],
    )
    file = options.output or file
    atomic_write(file, text.encode())
    console.print(f"{len(found.lengths)} policies written to {file} ({len(text) / 1000:.0f} kB)")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
