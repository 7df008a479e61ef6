"""LeftTurn's best-known front: the fixed rules and learnt policies that no other of them dominates.

Its traffic differs from episode to episode, so no sequence of actions is a policy, and the front is one of mean
returns, each with its interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from algorithms.agent import FrontAgent
from algorithms.driving.left_turn_rules import SCENARIO, GapDriver, GapRule
from algorithms.experiments.policy_evaluation import evaluate_front_policies, evaluate_policies
from algorithms.planning.rules_report import load_turner
from mo_deepdrive.atomic_io import atomic_write, csv_bytes
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.pareto import hypervolume, non_dominated
from mo_deepdrive.evaluation.splits import first_seed
from mo_deepdrive.reference_points import reference_point

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from algorithms.experiments.run_directory import Run
    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.splits import Split

GAMMA = 1.0


@dataclass(frozen=True)
class MeasuredDriver:
    """A policy and its episodes.

    Attributes:
        source: a run, or the rules.
        name: which of the source's policies.
        evaluation: in the same episodes for all drivers.
    """

    source: str
    name: str
    evaluation: Evaluation


def drive_rules(gaps: Iterable[float], *, episodes: int, split: Split) -> list[MeasuredDriver]:
    """The rule that waits for a gap in the traffic, for each of ``gaps`` (s).

    Raises:
        ValueError: for an invalid gap, or more episodes than the split has.
    """
    rules = [GapRule(gap=gap) for gap in gaps]
    return [
        MeasuredDriver(
            "rules", f"gap {rule.gap:g} s", evaluate(GapDriver(rule), SCENARIO.id, split=split, episodes=episodes)
        )
        for rule in rules
    ]


def drive_run(run: Run, *, episodes: int, split: Split) -> list[MeasuredDriver]:
    """The policies of a run: all of its front, or the greedy one and the one that samples.

    Raises:
        ValueError: for a run of another environment or of other objectives, or more episodes than the split has.
    """
    experiment, agent = run.experiment, load_turner(run)
    seed = first_seed(split, None, episodes)
    if isinstance(agent, FrontAgent):
        front = Front.read(run.path)
        found = evaluate_front_policies(agent, front, experiment, episodes=episodes, seed=seed)
        return [MeasuredDriver(run.path.name, f"policy {k}", each) for k, each in enumerate(found)]
    by_name = evaluate_policies(agent, experiment, episodes=episodes, seed=seed)
    return [MeasuredDriver(run.path.name, name, each) for name, each in by_name.items()]


@dataclass(frozen=True)
class JointFront:
    """The front of K drivers.

    Attributes:
        drivers: the K drivers.
        means: their mean undiscounted returns with intervals, a row per driver, dominated ones included.
        kept: (K,) whether no other driver dominates the mean return.
    """

    drivers: Sequence[MeasuredDriver]
    means: Front
    kept: NDArray[np.bool_]

    @classmethod
    def of(cls, drivers: Sequence[MeasuredDriver], seed: int) -> JointFront:
        """The front of ``drivers``, whose first episode has ``seed``."""
        returns, lengths, succeeded = (
            np.stack([getattr(driver.evaluation, name)[:, 0] for driver in drivers])
            for name in ("returns", "lengths", "succeeded")
        )
        means = Front.of_episodes(SCENARIO.objectives, returns, returns, lengths, succeeded, gamma=GAMMA, seed=seed)
        return cls(drivers, means, non_dominated(means.returns))

    def summary(self) -> list[list[str]]:
        """A table, header first: policies, kept policies and hypervolume of every source, and of all."""
        corner = reference_point("left_turn", gamma=GAMMA).values
        sources = np.array([driver.source for driver in self.drivers])
        rows = [["source", "policies", "non-dominated", "hypervolume"]]
        for source in (*dict.fromkeys(sources.tolist()), "all"):
            own = np.ones(len(sources), dtype=np.bool_) if source == "all" else sources == source
            volume = hypervolume(self.means.returns[own], corner)
            rows.append([source, str(own.sum()), str((own & self.kept).sum()), f"{volume:.4g}"])
        return rows

    def write(self, path: Path) -> None:
        """Write a CSV with a row per driver: whether it is kept, arrivals, and mean returns with their intervals.

        Raises:
            OSError: if the file cannot be written; it is complete or unchanged.
        """
        names = [f"{name}{end}" for name in self.means.objectives for end in ("", "_low", "_high")]
        rows: list[list[object]] = [["source", "policy", "episodes", "non_dominated", "arrived", *names]]
        blocks = np.stack([self.means.returns, self.means.low, self.means.high], axis=2).reshape(len(self.drivers), -1)
        for driver, kept, arrived, numbers in zip(
            self.drivers, self.kept, self.means.success, np.round(blocks, 4).tolist(), strict=True
        ):
            rows.append(
                [driver.source, driver.name, self.means.episodes, int(kept), round(float(arrived), 4), *numbers]
            )
        atomic_write(path, csv_bytes(rows))
