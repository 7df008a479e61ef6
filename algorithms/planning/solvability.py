"""Which random scenarios of StaticObstacle can be solved at all: an upper bound for the success of every policy.

Each scenario is searched best first, with more nodes and finer bins until a search arrives, and the solution is
replayed in the public environment. "Not solved" means not within these searches, so that the share of unsolved
scenarios bounds the share of impossible ones from above.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

import mo_deepdrive  # noqa: F401  (registers the ids)
from algorithms.planning.best_first_search import LETTERS, BestFirstSearch, SearchLimits, SearchResult
from mo_deepdrive.simulation.geometry import HALF_LENGTH, HALF_WIDTH
from mo_deepdrive.simulation.state import ARRIVED, ENDS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

ENVIRONMENT = "mo-deepdrive-static-obstacle-v0"
# Each search is wider and finer than the one before.
SEARCHES = (
    SearchLimits(beam_share=1 / 8, capacity=16, metres=1.0, radians=0.3, steer=0.06, root_speed=0.5),
    SearchLimits(beam_share=1 / 2, capacity=16, metres=0.5, radians=0.15, steer=0.06, root_speed=0.5),
    SearchLimits(beam_share=1.0, capacity=32, metres=0.2, radians=0.1, steer=0.06, root_speed=0.5),
    SearchLimits(beam_share=1.0, capacity=64, metres=0.05, radians=0.03, steer=0.03, root_speed=0.25),
)


@dataclass(frozen=True)
class ScenarioOutcome:
    """Whether a scenario was solved.

    Attributes:
        start: (1,) of VEHICLE, the state in which the scenario begins.
        actions: of the solution, a letter per decision ("a" for action 0); "" if none was found.
        nodes: number of nodes that the last search kept.
        exhausted: whether the last search expanded all of them.
    """

    start: NDArray[Any]
    actions: str
    nodes: int
    exhausted: bool

    @property
    def solved(self) -> bool:
        """Whether a solution was found."""
        return self.actions != ""


def solve_scenario(start: NDArray[Any], beam: int) -> ScenarioOutcome:
    """Search from ``start`` (1,) of VEHICLE, ever wider and finer, until a search arrives.

    Args:
        start: the state in which the scenario begins.
        beam: states simulated at a time.
    """
    result = SearchResult("", 0, exhausted=False)
    for limits in SEARCHES:
        result = BestFirstSearch(start, limits, beam).run()
        if result.actions:
            break
    return ScenarioOutcome(start, result.actions, result.nodes, result.exhausted)


def replay(env: Any, seed: int, actions: str) -> None:
    """Replay a solution in the public environment ``env`` after ``reset(seed=seed)``.

    Raises:
        RuntimeError: unless the last of ``actions`` arrives.
    """
    env.reset(seed=seed)
    ends = [env.step(LETTERS.index(letter))[-1].get("end") for letter in actions]
    if ends[-1] != ENDS[ARRIVED]:
        raise RuntimeError(f"the solution of seed {seed} ends with {ends[-1]!r} in the environment")


def solve_scenarios(seeds: Iterable[int], beam: int) -> list[ScenarioOutcome]:
    """Solve the scenarios that ``reset(seed=seed)`` draws, and replay their solutions.

    Args:
        seeds: of the scenarios.
        beam: states simulated at a time.

    Raises:
        RuntimeError: if a solution does not arrive in the public environment.
    """
    env: Any = gymnasium.make(ENVIRONMENT, disable_env_checker=True)
    outcomes = []
    for seed in seeds:
        env.reset(seed=seed)
        outcome = solve_scenario(env.unwrapped.batch.state[0].copy(), beam)
        if outcome.solved:
            replay(env, seed, outcome.actions)
        outcomes.append(outcome)
    return outcomes


def describe_geometry(start: NDArray[Any]) -> list[str]:
    """Where the bicycle and the destination are at the start of a scenario, relative to the vehicle.

    Args:
        start: (1,) of VEHICLE.

    Returns:
        The gap between vehicle and bicycle (m), then both ends of the bicycle and the destination, each as metres
        ahead of the nose and metres to the left.
    """
    vehicle = start[0]
    ahead = complex(-vehicle["sin_heading"], vehicle["cos_heading"])
    points = np.concatenate([vehicle["obstacle"], vehicle["waypoints"][:1]]) @ (1, 1j)
    first, second, goal = (points - complex(vehicle["x"], vehicle["y"])) / ahead  # real: ahead, imaginary: left
    along = first + np.linspace(0.0, 1.0, 1001) * (second - first)
    gap = np.hypot(np.maximum(abs(along.real) - HALF_LENGTH, 0.0), np.maximum(abs(along.imag) - HALF_WIDTH, 0.0)).min()
    return [f"{gap:.2f}", *(f"{point.real - HALF_LENGTH:.2f}, {point.imag:.2f}" for point in (first, second, goal))]


def write_outcomes(file: Path, outcomes: Sequence[ScenarioOutcome]) -> None:
    """Write one CSV row per scenario: its number, whether it was solved, decisions and actions of the solution."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(("scenario", "solved", "decisions", "actions"))
        for i, outcome in enumerate(outcomes):
            writer.writerow((i, int(outcome.solved), len(outcome.actions) or "", outcome.actions))
