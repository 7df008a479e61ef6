"""Plans: the sequences of actions that the front search stores, varies and evaluates.

A plan holds one action per decision of a whole episode and is the genome of the search. Plans of every action set are
int16 arrays (decisions, k), so that the same code mutates them: a discrete action is its index (k = 1), a continuous
one is steer, acceleration and brake (k = 3) in units of 1 / FULL_SCALE, the resolution of a front's file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mo_deepdrive.fronts.reference_fronts import GAMMA, TIME
from mo_deepdrive.world.action_sequences import CONTINUOUS_UNIT
from mo_deepdrive.world.action_sequences import idle as idle_action
from mo_deepdrive.world.actions import CONTINUOUS, action_table
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from collections.abc import Sequence

FULL_SCALE = round(1 / CONTINUOUS_UNIT)  # units of a continuous action of 1.0

Plans = NDArray[np.int16]  # (n, decisions, k)


@dataclass(frozen=True)
class Criterion:
    """Which returns are maximised: of the scenario's objectives, and perhaps of the time.

    Attributes:
        gamma: discount factor.
        timed: whether time is an objective, too. Without a discount nothing else tells a drive from the same after a
            wait.
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
    """How the actions of one action set are stored in plans.

    Args:
        action_type: "discrete", "discrete-16" or "continuous".
        decisions: length of a plan: the most decisions in an episode.

    Attributes:
        decisions: as given.
        continuous: whether the action set is continuous.
        idle: (k,) the action that does nothing, as plans store it.
        table: the action table of a discrete set; (0, 4) for a continuous one.
    """

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
    """n plans and the returns of their episodes.

    Attributes:
        plans: (n, decisions, k) the actions; idle after the end of the episode.
        lengths: (n,) decisions until the episode ended.
        returns: (n, d) returns for each of CRITERIA, maximised.
        sources: (n,) index of what found the plan, in a list that the caller keeps.
    """

    plans: Plans
    lengths: NDArray[np.int64]
    returns: tuple[NDArray[np.float64], ...]
    sources: NDArray[np.int64]

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
