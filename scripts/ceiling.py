"""How many random StaticObstacle scenarios can be solved at all: a ceiling for every policy.

    python scripts/ceiling.py --scenarios 200 --seed 1000000 --output ceiling.csv

Scenario i is what ``reset(seed=seed + i)`` draws. It is searched best first with the simulator itself: the most
promising worlds found so far are copied, once per action, and every action is held for a few decisions; of the worlds
that come to lie in one bin of pose, speed and steer one is kept. Searches go from few worlds and coarse bins to many
and fine ones until one arrives, not necessarily in the fewest decisions; its actions are replayed in the public
environment. "Not solved" means not within these searches: it bounds the impossible scenarios from above.
"""

from __future__ import annotations

import argparse
import csv
import string
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import binomtest

import mo_deepdrive  # noqa: F401  (registers the ids)
from mo_deepdrive.actions import action_table
from mo_deepdrive.batch import WorldBatch
from mo_deepdrive.config import EnvConfig
from mo_deepdrive.simulation.geometry import HALF_LENGTH, HALF_WIDTH
from mo_deepdrive.simulation.state import ARRIVED, ENDS, RUNNING, VEHICLE, YAW_FRICTION

ENVIRONMENT = "mo-deepdrive-static-obstacle-v0"
CONFIG = EnvConfig(scenario="static_obstacle")
LETTERS = string.ascii_lowercase[: len(action_table(CONFIG.action_type))]  # one per action
HOLDS = (1, 2, 6, 20)  # decisions for which an action is held
CLEARANCE = HALF_WIDTH + 0.5  # m beyond the bicycle's ends, where the estimated way leads around it
TURN_COST = 1.5  # m per rad
TIME_COST = 0.05  # m per decision
TURN_TO_COME = YAW_FRICTION / (1.0 - YAW_FRICTION)  # rad that a car still turns once nothing steers it, per rad a step


@dataclass(frozen=True)
class Rung:
    """One search: the share of the beam that it drives at a time, how many beams it keeps, the sizes of its bins."""

    share: float
    capacity: int
    metres: float
    radians: float
    steer: float  # rad
    root_speed: float  # (m/s)^0.5, so that bins are finer at a crawl


RUNGS = (
    Rung(share=1 / 8, capacity=16, metres=1.0, radians=0.3, steer=0.06, root_speed=0.5),
    Rung(share=1 / 2, capacity=16, metres=0.5, radians=0.15, steer=0.06, root_speed=0.5),
    Rung(share=1.0, capacity=32, metres=0.2, radians=0.1, steer=0.06, root_speed=0.5),
    Rung(share=1.0, capacity=64, metres=0.05, radians=0.03, steer=0.03, root_speed=0.25),
)


@dataclass(frozen=True)
class Outcome:
    """What was found: actions that arrive, or none; how many worlds the last search kept, and whether it tried all."""

    actions: str
    kept: int
    exhausted: bool


def left_of(start: NDArray[Any], end: NDArray[Any], point: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether a point lies to the left of the line from ``start`` to ``end`` (complex numbers)."""
    return np.asarray(((end - start).conj() * (point - start)).imag > 0.0)


def estimates(states: NDArray[Any]) -> NDArray[np.float64]:
    """How far each world (n,) of VEHICLE is from arriving: the way around the bicycle (m), turns and time."""
    front = states["front_x"] + 1j * states["front_y"]
    goal, first, second = (xy @ (1, 1j) for xy in (states["waypoints"][:, 0], *states["obstacle"].swapaxes(0, 1)))
    outward = CLEARANCE * (second - first) / np.abs(second - first)
    left, right = first - outward, second + outward
    blocked = left_of(front, goal, left) != left_of(front, goal, right)
    blocked &= left_of(left, right, front) != left_of(left, right, goal)
    by_left = np.abs(front - left) + np.abs(goal - left)
    by_right = np.abs(front - right) + np.abs(goal - right)
    way = np.where(blocked, np.minimum(by_left, by_right), np.abs(goal - front))
    target = np.where(blocked, np.where(by_left < by_right, left, right), goal)
    ahead = -states["sin_heading"] + 1j * states["cos_heading"]
    turn = np.abs(np.angle((target - front) * ahead.conj()))
    return np.asarray(way + TURN_COST * turn + TIME_COST * states["decisions"])


def bins(states: NDArray[Any], rung: Rung) -> list[bytes]:
    """The bin of each world (n,) of VEHICLE, including the turn that its rotation still holds."""
    columns = (
        states["x"] / rung.metres,
        states["y"] / rung.metres,
        states["heading"] / rung.radians,
        states["yaw_step"] * TURN_TO_COME / rung.radians,
        states["steer"] / rung.steer,
        np.sqrt(np.abs(states["speed"])) / rung.root_speed,
    )
    rounded = np.rint(np.stack(columns, axis=1)).astype(np.int16)
    keys: list[bytes] = rounded.view(f"V{rounded.itemsize * len(columns)}").ravel().tolist()
    return keys


class Search:
    """A best-first search from the worlds ``start`` (1,) that drives a share of ``beam`` worlds at a time."""

    def __init__(self, start: NDArray[Any], rung: Rung, beam: int):
        self.rung = rung
        self.batch = WorldBatch(CONFIG, max(len(LETTERS), int(beam * rung.share)))
        self.states = np.zeros(rung.capacity * len(self.batch.state), dtype=VEHICLE)
        self.scores = np.zeros(len(self.states))  # infinite for worlds that have been driven on
        self.paths: list[str] = []  # the actions that lead to each world kept
        self.seen: set[bytes] = set()
        self._keep(start, [""])

    def run(self) -> Outcome:
        """Drive on until a world arrives, none is left, or no more can be kept."""
        while len(self.paths) < len(self.states):
            rows = self._best()
            if not len(rows):
                return Outcome("", len(self.paths), exhausted=True)
            actions = self._drive(rows)
            if actions:
                return Outcome(actions, len(self.paths), exhausted=False)
        return Outcome("", len(self.paths), exhausted=False)

    def _keep(self, states: NDArray[Any], paths: list[str]) -> None:
        """Keep the most promising world of every bin that is new."""
        scores = estimates(states)
        keys = bins(states, self.rung)
        rows = []
        for row in np.argsort(scores, kind="stable").tolist():
            if keys[row] not in self.seen:
                self.seen.add(keys[row])
                rows.append(row)
        kept = len(self.paths)
        rows = rows[: len(self.states) - kept]
        self.states[kept : kept + len(rows)] = states[rows]
        self.scores[kept : kept + len(rows)] = scores[rows]
        self.paths += [paths[row] for row in rows]

    def _best(self) -> NDArray[np.int64]:
        """The most promising worlds not yet driven on, as many as the simulator can try every action in."""
        scores = self.scores[: len(self.paths)]
        count = min(len(self.batch.state) // len(LETTERS), len(scores))
        rows = np.argpartition(scores, count - 1)[:count]
        return rows[np.isfinite(scores[rows])]

    def _drive(self, rows: NDArray[np.int64]) -> str:
        """Hold every action in copies of the worlds ``rows``; the actions of the first to arrive, or none."""
        self.scores[rows] = np.inf
        batch = self.batch
        before = [self.paths[row] for row in rows for _ in LETTERS]
        actions = np.resize(np.arange(len(LETTERS)), len(batch.state))
        worlds = batch.state[: len(before), 0]
        worlds[:] = np.repeat(self.states[rows], len(LETTERS))
        batch.state["end"][len(before) :] = ENDS.index("time_limit")  # nobody drives there
        states, paths = [], []
        for held in range(1, max(HOLDS) + 1):
            batch.step(actions[:, None])
            for row in np.flatnonzero(worlds["end"] == ARRIVED):
                return before[row] + LETTERS[actions[row]] * held
            if held in HOLDS:
                running = np.flatnonzero(worlds["end"] == RUNNING)
                states.append(worlds[running])
                paths += [before[row] + LETTERS[actions[row]] * held for row in running]
        self._keep(np.concatenate(states), paths)
        return ""


def solve(start: NDArray[Any], beam: int) -> Outcome:
    """Search from the worlds ``start`` (1,) of VEHICLE with more worlds and finer bins until a search arrives."""
    for rung in RUNGS:
        outcome = Search(start, rung, beam).run()
        if outcome.actions:
            break
    return outcome


def replay(env: Any, seed: int, actions: str) -> None:
    """Drive ``actions`` in the public environment.

    Raises:
        RuntimeError: unless the last of them arrives.
    """
    env.reset(seed=seed)
    ends = [env.step(LETTERS.index(letter))[-1].get("end") for letter in actions]
    if ends[-1] != "arrived":
        raise RuntimeError(f"the solution of seed {seed} ends with {ends[-1]!r} in the environment")


def geometry(world: NDArray[Any]) -> list[str]:
    """How far the bicycle is from the vehicle, its ends and the destination: cells of the table."""
    ahead = complex(-world["sin_heading"], world["cos_heading"])
    points = np.concatenate([world["obstacle"], world["waypoints"][:1]]) @ (1, 1j)
    first, second, goal = (points - complex(world["x"], world["y"])) / ahead  # real: ahead, imaginary: left
    along = first + np.linspace(0.0, 1.0, 1001) * (second - first)
    gap = np.hypot(np.maximum(abs(along.real) - HALF_LENGTH, 0.0), np.maximum(abs(along.imag) - HALF_WIDTH, 0.0)).min()
    return [f"{gap:.2f}", *(f"{point.real - HALF_LENGTH:.2f}, {point.imag:.2f}" for point in (first, second, goal))]


def report(outcomes: list[Outcome], starts: list[NDArray[Any]], console: Console) -> None:
    """Print the ceiling, and the scenarios that were not solved."""
    lengths = [len(outcome.actions) for outcome in outcomes if outcome.actions]
    interval = binomtest(len(lengths), len(outcomes)).proportion_ci(method="wilson")
    table = Table("quantity", "value", title="StaticObstacle: what can be solved")
    table.add_row("scenarios", str(len(outcomes)))
    table.add_row("solved", f"{len(lengths)} ({len(lengths) / len(outcomes):.2%})")
    table.add_row("95% interval (Wilson)", f"{interval.low:.2%} to {interval.high:.2%}")
    table.add_row("mean decisions of the solutions found", f"{np.mean(lengths):.1f}" if lengths else "-")
    console.print(table)
    columns = ("scenario", "gap (m)", "bicycle from", "to", "destination", "worlds kept", "exhausted")
    table = Table(*columns, title="Not solved: m ahead of the nose, m to its left")
    for i, outcome in enumerate(outcomes):
        if not outcome.actions:
            table.add_row(str(i), *geometry(starts[i][0]), str(outcome.kept), "yes" if outcome.exhausted else "no")
    if table.row_count:
        console.print(table)


def write(file: Path, outcomes: list[Outcome]) -> None:
    """Write one line per scenario."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(("scenario", "solved", "decisions", "actions"))
        for i, outcome in enumerate(outcomes):
            writer.writerow((i, int(outcome.actions != ""), len(outcome.actions) or "", outcome.actions))


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="The share of StaticObstacle scenarios that can be solved at all.")
    parser.add_argument("--scenarios", type=int, default=200, help="how many (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1_000_000, help="scenario i has seed + i (default: %(default)s)")
    parser.add_argument("--output", type=Path, help="CSV: scenario, solved, decisions, actions (letters, a for 0)")
    parser.add_argument("--beam", type=int, default=4096, help="worlds driven at a time (default: %(default)s)")
    options = parser.parse_args(arguments)
    for name, least in (("scenarios", 1), ("seed", 0), ("beam", len(LETTERS))):
        if getattr(options, name) < least:
            parser.error(f"--{name} {getattr(options, name)} must be at least {least}")
    if options.output is not None and not options.output.parent.is_dir():
        parser.error(f"--output {options.output}: there is no folder {options.output.parent}")
    return options


def main(arguments: list[str] | None = None) -> None:
    options = parse_arguments(arguments)
    env: Any = gymnasium.make(ENVIRONMENT, disable_env_checker=True)
    outcomes, starts = [], []
    seeds = range(options.seed, options.seed + options.scenarios)
    for seed in track(seeds, "searching", console=Console(stderr=True), transient=True):
        env.reset(seed=seed)
        starts.append(env.unwrapped.batch.state[0].copy())
        outcomes.append(solve(starts[-1], options.beam))
        if outcomes[-1].actions:
            replay(env, seed, outcomes[-1].actions)
    if options.output is not None:
        write(options.output, outcomes)
    report(outcomes, starts, Console(width=120))


if __name__ == "__main__":
    main()
