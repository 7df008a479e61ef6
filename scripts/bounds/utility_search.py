"""The evolutionary search for the best plan of one scenario under each of some utilities: ceilings of the suite.

A decomposition-based evolutionary algorithm in the manner of MOEA/D (Zhang and Li 2007): every utility keeps its best
plans, and an offspring of any of them may improve any utility. Random driving rules make the first generation, and
take over from some of the offspring later, as in :mod:`scripts.bounds.front_search`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.simulation.actions import decode_discrete
from mo_deepdrive.simulation.state import MAX_ACCELERATION, STEER_RANGE
from scripts.bounds.driving_rules import random_calm_rules
from scripts.bounds.plans import CRITERIA, Criterion, EvaluatedPlans
from scripts.bounds.variation import make_offspring

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from scripts.bounds.plan_evaluation import PlanEvaluator

FIRST = 2048  # rules of the first generation
POPULATION = 1024  # plans of each later one
TAKEOVER_RATE = 0.05  # share of the offspring that a rule takes over
KEPT = 96  # best plans, divided among the utilities; at least LEAST_KEPT of each
LEAST_KEPT = 2
BLIND_POPULATION, BLIND_KEPT, BLIND_GENERATIONS = 256, 48, 25
UNDISCOUNTED = CRITERIA.index(Criterion(1.0, timed=True))


class UtilitySearch:
    """Searches for the best plan of a scenario under each of P utilities.

    Args:
        evaluator: of the scenario's plans; its start is overwritten.
        values: from returns (n, d) to utilities (n, P); the returns are undiscounted, in the order of the evaluator's
            objectives with the time after them.
        unfinished: seconds that are charged unless the drive arrives.
        seed: of all random choices.
    """

    def __init__(
        self,
        evaluator: PlanEvaluator,
        values: Callable[[NDArray[np.float64]], NDArray[np.float64]],
        unfinished: float,
        seed: int,
    ):
        self.evaluator = evaluator
        self._values = values
        self._unfinished = unfinished
        self._rng = np.random.default_rng(seed)
        self._destination = evaluator.batch.objectives.index("destination")

    def best(
        self, start: NDArray[Any], sequences: Sequence[NDArray[Any]], generations: int
    ) -> tuple[EvaluatedPlans, NDArray[np.float64]]:
        """The best plan found for each utility, (P,) of them, and their utilities (P,).

        Args:
            start: (1,) of VEHICLE, the state in which the scenario begins.
            sequences: of environment actions, from which the search also starts.
            generations: after the first one.
        """
        self.evaluator.batch.state[0] = start
        plan_format, n_actions = self.evaluator.format, len(self.evaluator.format.table)
        idle = plan_format.to_sequence(plan_format.idle_plans(1)[0])
        kept = self.evaluator.evaluate(plan_format.from_sequences([idle, *sequences]), 0)
        kept = kept.append(self._ruled(plan_format.idle_plans(FIRST), np.zeros(FIRST)))
        kept, values = self._select(kept, self.values(kept))
        for _ in range(generations):
            parents, mates = self._rng.integers(len(kept.plans), size=(2, POPULATION))
            plans = plan_format.idle_plans(POPULATION)
            make_offspring(
                kept.plans[parents],
                kept.lengths[parents],
                kept.plans[mates],
                kept.lengths[mates],
                plans,
                n_actions,
                plan_format.idle,
                self._rng,
            )
            taken_over = self._rng.random(POPULATION) < TAKEOVER_RATE
            takeovers = self._rng.random(POPULATION) * kept.lengths[parents]
            offspring = self._ruled(plans, np.where(taken_over, takeovers, plan_format.decisions))
            kept, values = self._select(kept.append(offspring), np.concatenate([values, self.values(offspring)]))
        best = values.argmax(axis=0)
        return kept.take(best), values.max(axis=0)

    def values(self, evaluated: EvaluatedPlans) -> NDArray[np.float64]:
        """The utilities (n, P) of plans."""
        return self._values(self.returns(evaluated))

    def returns(self, evaluated: EvaluatedPlans) -> NDArray[np.float64]:
        """The undiscounted returns (n, d) of plans, with the time that is charged last."""
        returns = evaluated.returns[UNDISCOUNTED].copy()
        arrived = returns[:, self._destination] > 0.0
        returns[~arrived, -1] = -self._unfinished
        return returns

    def _ruled(self, plans: NDArray[np.int16], first_decisions: NDArray[Any]) -> EvaluatedPlans:
        """The plans, in which random rules drive from the given decisions on."""
        rules = random_calm_rules(len(plans), self._rng)
        rules["first_decision"] = first_decisions
        return self.evaluator.evaluate(plans, 0, rules)

    def _select(
        self, evaluated: EvaluatedPlans, values: NDArray[np.float64]
    ) -> tuple[EvaluatedPlans, NDArray[np.float64]]:
        """The best plans of every utility, with their utilities; of those that are worth the same the first."""
        count = max(LEAST_KEPT, KEPT // values.shape[1])
        rows = set()
        for column in values.T:
            _, first = np.unique(-column, return_index=True)
            rows |= set(first[:count].tolist())
        chosen = np.array(sorted(rows))
        return evaluated.take(chosen), values[chosen]


def as_continuous(evaluator: PlanEvaluator, start: NDArray[Any], actions: NDArray[Any]) -> NDArray[np.float64]:
    """The continuous actions (t, 3) that give the vehicle the controls of discrete ones (t,).

    Args:
        evaluator: of discrete plans.
        start: (1,) of VEHICLE, the state in which the scenario begins.
        actions: (t,) discrete actions.
    """
    batch = evaluator.batch
    batch.state[0] = start
    controls, found = np.zeros((1, 1, 3)), []
    for action in actions:
        decode_discrete(batch.state, 0, 0, action, batch.table, controls)
        steer, throttle, brake = controls[0, 0]
        found.append((steer / STEER_RANGE, throttle / MAX_ACCELERATION, 2.0 * brake / MAX_ACCELERATION - 1.0))
        batch.step(np.full((1, 1), action))
    return np.clip(np.array(found), -1.0, 1.0)


def blind_plan(
    evaluator: PlanEvaluator,
    values: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    unfinished: float,
    starts: Sequence[NDArray[Any]],
    held: Sequence[NDArray[Any]],
) -> tuple[NDArray[Any], float]:
    """The sequence of actions that is worth most in the mean over scenarios: the best policy that sees the time alone.

    Args:
        evaluator: as of :class:`UtilitySearch`.
        values: from returns (n, d) to utilities (n,).
        unfinished: as of :class:`UtilitySearch`.
        starts: each (1,) of VEHICLE, the states in which the scenarios begin.
        held: sequences of environment actions, from which the search starts.

    Returns:
        The environment actions, and what they are worth.
    """
    search = UtilitySearch(evaluator, values, unfinished, 0)
    plan_format, rng = evaluator.format, np.random.default_rng(0)
    plans = plan_format.from_sequences(held)
    kept, worth = plans[:0], np.zeros(0)
    for generation in range(BLIND_GENERATIONS + 1):
        if generation:
            parents, mates = rng.integers(len(kept), size=(2, BLIND_POPULATION))
            lengths = np.full(BLIND_POPULATION, plan_format.decisions)
            plans = plan_format.idle_plans(BLIND_POPULATION)
            n_actions, idle = len(plan_format.table), plan_format.idle
            make_offspring(kept[parents], lengths, kept[mates], lengths, plans, n_actions, idle, rng)
        total = np.zeros(len(plans))
        for start in starts:
            evaluator.batch.state[0] = start
            total += search.values(evaluator.evaluate(plans.copy(), 0))
        kept, worth = np.concatenate([kept, plans]), np.concatenate([worth, total / len(starts)])
        _, rows = np.unique(-worth, return_index=True)
        kept, worth = kept[rows[:BLIND_KEPT]], worth[rows[:BLIND_KEPT]]
    return plan_format.to_sequence(kept[0]), float(worth[0])
