"""Best-first search for actions that bring a vehicle past the bicycle of StaticObstacle to its destination.

The nodes are states of the simulation. The search expands many of the most promising nodes at a time (K-best-first
search, Felner, Kraus and Korf 2003): each is copied once per action, and every action is held for a few decisions. Of
the nodes whose pose, speed and steer fall into one bin only the first is kept, as in hybrid A* (Dolgov et al. 2008).
The search is neither optimal nor complete: a solution need not take the fewest decisions.
"""

from __future__ import annotations

import string
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.simulation.geometry import HALF_WIDTH
from mo_deepdrive.simulation.state import ARRIVED, RUNNING, TIME_LIMIT, YAW_FRICTION
from mo_deepdrive.world.actions import action_table
from mo_deepdrive.world.batch import WorldBatch
from mo_deepdrive.world.config import EnvConfig

if TYPE_CHECKING:
    from numpy.typing import NDArray

CONFIG = EnvConfig(scenario="static_obstacle")
LETTERS = string.ascii_lowercase[: len(action_table(CONFIG.action_type))]  # one per action
HOLDS = (1, 2, 6, 20)  # decisions for which an action is held
CLEARANCE = HALF_WIDTH + 0.5  # distance (m) from the bicycle's ends at which the estimated way passes it
TURN_COST = 1.5  # m per rad
TIME_COST = 0.05  # m per decision
COASTING_TURN = YAW_FRICTION / (1.0 - YAW_FRICTION)  # rad that a car still turns without steering, per rad of yaw_step


@dataclass(frozen=True)
class SearchLimits:
    """How wide a search is, and the sizes of its bins."""

    beam_share: float  # of the beam whose nodes are expanded at a time
    capacity: int  # nodes kept at most, in expansions
    metres: float
    radians: float  # of the heading
    steer: float  # rad
    root_speed: float  # of the square root of the speed ((m/s)^0.5), so that bins are finer at low speed


# Each search is wider and finer than the one before.
SEARCHES = (
    SearchLimits(beam_share=1 / 8, capacity=16, metres=1.0, radians=0.3, steer=0.06, root_speed=0.5),
    SearchLimits(beam_share=1 / 2, capacity=16, metres=0.5, radians=0.15, steer=0.06, root_speed=0.5),
    SearchLimits(beam_share=1.0, capacity=32, metres=0.2, radians=0.1, steer=0.06, root_speed=0.5),
    SearchLimits(beam_share=1.0, capacity=64, metres=0.05, radians=0.03, steer=0.03, root_speed=0.25),
)


def lies_left(start: NDArray[Any], end: NDArray[Any], point: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether ``point`` lies to the left of the line from ``start`` to ``end`` (complex numbers)."""
    return np.asarray(((end - start).conj() * (point - start)).imag > 0.0)


def estimated_costs(states: NDArray[Any]) -> NDArray[np.float64]:
    """The cost (n,) by which nodes are ordered, f = g + h: decisions so far, the way around the bicycle, and turns."""
    front = states["front_x"] + 1j * states["front_y"]
    goal, first, second = (xy @ (1, 1j) for xy in (states["waypoints"][:, 0], *states["obstacle"].swapaxes(0, 1)))
    outward = CLEARANCE * (second - first) / np.abs(second - first)
    left, right = first - outward, second + outward
    blocked = lies_left(front, goal, left) != lies_left(front, goal, right)
    blocked &= lies_left(left, right, front) != lies_left(left, right, goal)
    by_left = np.abs(front - left) + np.abs(goal - left)
    by_right = np.abs(front - right) + np.abs(goal - right)
    way = np.where(blocked, np.minimum(by_left, by_right), np.abs(goal - front))
    target = np.where(blocked, np.where(by_left < by_right, left, right), goal)
    ahead = -states["sin_heading"] + 1j * states["cos_heading"]
    turn = np.abs(np.angle((target - front) * ahead.conj()))
    return np.asarray(way + TURN_COST * turn + TIME_COST * states["decisions"])


def bins(states: NDArray[Any], limits: SearchLimits) -> list[bytes]:
    """The bin of each state (n,) of VEHICLE; the rotation counts as the turn that it leads to."""
    columns = (
        states["x"] / limits.metres,
        states["y"] / limits.metres,
        states["heading"] / limits.radians,
        states["yaw_step"] * COASTING_TURN / limits.radians,
        states["steer"] / limits.steer,
        np.sqrt(np.abs(states["speed"])) / limits.root_speed,
    )
    rounded = np.rint(np.stack(columns, axis=1)).astype(np.int16)
    keys: list[bytes] = rounded.view(f"V{rounded.itemsize * len(columns)}").ravel().tolist()
    return keys


class BestFirstSearch:
    """A search from the state ``start`` (1,) of VEHICLE; ``beam`` states are simulated at a time, or a share of it."""

    def __init__(self, start: NDArray[Any], limits: SearchLimits, beam: int):
        self.limits = limits
        self.batch = WorldBatch(CONFIG, max(len(LETTERS), int(beam * limits.beam_share)))
        self.states = np.zeros(limits.capacity * len(self.batch.state), dtype=self.batch.state.dtype)
        self.costs = np.zeros(len(self.states))  # infinite for nodes that have been expanded
        self.paths: list[str] = []  # the actions that lead to each node
        self.visited: set[bytes] = set()  # bins
        self._add(start, [""])

    def run(self) -> str:
        """A letter per decision ("a" for action 0) that leads to the destination; "" if no node arrives."""
        while len(self.paths) < len(self.states):
            nodes = self._best_nodes()
            if not len(nodes):
                break
            if actions := self._expand(nodes):
                return actions
        return ""

    def _add(self, states: NDArray[Any], paths: list[str]) -> None:
        """Add the most promising state of every bin that was not visited, up to the capacity."""
        costs = estimated_costs(states)
        keys = bins(states, self.limits)
        rows = []
        for row in np.argsort(costs, kind="stable").tolist():
            if keys[row] not in self.visited:
                self.visited.add(keys[row])
                rows.append(row)
        count = len(self.paths)
        rows = rows[: len(self.states) - count]
        self.states[count : count + len(rows)] = states[rows]
        self.costs[count : count + len(rows)] = costs[rows]
        self.paths += [paths[row] for row in rows]

    def _best_nodes(self) -> NDArray[np.int64]:
        """The nodes of least cost that have not been expanded, as many as fit into the batch with every action."""
        costs = self.costs[: len(self.paths)]
        count = min(len(self.batch.state) // len(LETTERS), len(costs))
        nodes = np.argpartition(costs, count - 1)[:count]
        return nodes[np.isfinite(costs[nodes])]

    def _expand(self, nodes: NDArray[np.int64]) -> str:
        """Hold every action in copies of the nodes; the actions that lead to the first arrival, or ""."""
        self.costs[nodes] = np.inf
        batch = self.batch
        before = [self.paths[node] for node in nodes for _ in LETTERS]
        actions = np.resize(np.arange(len(LETTERS)), len(batch.state))
        vehicles = batch.state[: len(before), 0]
        vehicles[:] = np.repeat(self.states[nodes], len(LETTERS))
        batch.state["end"][len(before) :] = TIME_LIMIT  # unused
        states, paths = [], []
        for held in range(1, max(HOLDS) + 1):
            batch.step(actions[:, None])
            for row in np.flatnonzero(vehicles["end"] == ARRIVED):
                solution: str = before[row] + LETTERS[actions[row]] * held
                return solution
            if held in HOLDS:
                running = np.flatnonzero(vehicles["end"] == RUNNING)
                states.append(vehicles[running])
                paths += [before[row] + LETTERS[actions[row]] * held for row in running]
        self._add(np.concatenate(states), paths)
        return ""


def solve_scenario(start: NDArray[Any], beam: int) -> list[int]:
    """An action per decision from ``start`` (1,) of VEHICLE, searched ever wider and finer; none if none arrives."""
    found = (BestFirstSearch(start, limits, beam).run() for limits in SEARCHES)
    return [LETTERS.index(letter) for letter in next(filter(None, found), "")]
