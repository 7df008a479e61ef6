"""The evolutionary search for the front of one scenario and action set.

An archive-based evolutionary algorithm in the manner of epsilon-MOEA (Deb, Mohan and Mishra 2005): parents are drawn
from the archive and, mostly, from the plans that would make up the front; offspring enter the archive if no other plan
epsilon-dominates them. Random driving rules make the first generations and take over from some of the offspring later.

The archive keeps one plan of every box of the objective space that no other box dominates (Laumanns et al. 2002,
"Combining convergence and diversity in evolutionary multiobjective optimization"), which bounds it and spreads it over
the front. The front is selected by hypervolume contribution (Guerreiro, Fonseca and Paquete 2016, "Greedy hypervolume
subset selection in low dimensions") with lazy updates: a contribution can only shrink as others are selected (Minoux
1978).
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, Any

import moocore
import numpy as np

from mo_deepdrive.fronts.reference_points import reference_point
from mo_deepdrive.world.objectives import scales
from scripts.bounds.driving_rules import random_calm_rules
from scripts.bounds.plan_evaluation import PlanEvaluator
from scripts.bounds.plans import CRITERIA, EvaluatedPlans
from scripts.bounds.variation import make_offspring

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

POPULATION = 4096  # plans per generation
RULE_GENERATIONS = 5  # first generations, of rules only
TAKEOVER_RATE = 0.1  # share of the offspring that a rule takes over
FRONT_RATE = 0.8  # share of the parents that are drawn from the front
FRONT_GENERATIONS = 50  # until the front is selected again
# Long episodes cost time: above SHORT_EPISODE decisions a plan becomes a parent in inverse proportion to its length,
# but at least with probability LEAST_PARENT_RATE.
SHORT_EPISODE = 60
LEAST_PARENT_RATE = 0.2
UNKNOWN_SOURCE = -1
EPSILON = 0.005  # edge of a box, as a share of each objective's nominal scale
# For each of CRITERIA, the most plans that are selected for it and those after it.
FRONT_SIZES = (350, 150, 100)


class FrontSearch:
    """A search for the front of one scenario and action set.

    Args:
        scenario: "one_waypoint" or "static_obstacle".
        action_type: "discrete", "discrete-16" or "continuous".
        seed: of all random choices.

    Attributes:
        references: the reference point (d,) of hypervolumes for each of CRITERIA.
        evaluator: simulates plans.
        archive: the plans that are kept; at first one that idles, of UNKNOWN_SOURCE.
        front: those of them that made up the front when it was last selected.
        generations: evolved so far.
    """

    def __init__(self, scenario: str, action_type: str, seed: int):
        self.objectives = [criterion.objectives(scenario) for criterion in CRITERIA]
        self.references = [
            reference_point(scenario, action_type, criterion.gamma, names).values
            for criterion, names in zip(CRITERIA, self.objectives, strict=True)
        ]
        self.evaluator = PlanEvaluator(scenario, action_type)
        self.rng = np.random.default_rng(seed)
        self.generations = 0
        self.archive = self.evaluator.evaluate(self.evaluator.format.idle_plans(1), UNKNOWN_SOURCE)
        self.front = self.archive

    def add(self, evaluated: EvaluatedPlans) -> None:
        """Update the archive with plans."""
        candidates = self.archive.append(evaluated)
        self.archive = candidates.take(epsilon_nondominated(candidates, self.objectives))

    def evolve(self, source: int) -> None:
        """Make and evaluate one generation of plans and update the archive; ``source`` is the index of their source."""
        plan_format = self.evaluator.format
        rules = random_calm_rules(POPULATION, self.rng)
        if self.generations < RULE_GENERATIONS:
            plans = plan_format.idle_plans(POPULATION)
        else:
            if (self.generations - RULE_GENERATIONS) % FRONT_GENERATIONS == 0:
                self.front = self.select_front()
            candidates = self.archive.append(self.front)
            parents, mates = self._select_parents(candidates), self._select_parents(candidates)
            n = min(len(parents), len(mates))
            parents, mates, rules = parents[:n], mates[:n], rules[:n]
            plans = plan_format.idle_plans(n)
            make_offspring(
                candidates.plans[parents],
                candidates.lengths[parents],
                candidates.plans[mates],
                candidates.lengths[mates],
                plans,
                len(plan_format.table),
                plan_format.idle,
                self.rng,
            )
            taken_over = self.rng.random(n) < TAKEOVER_RATE
            takeovers = self.rng.random(n) * candidates.lengths[parents]
            rules["first_decision"] = np.where(taken_over, takeovers, plan_format.decisions)
        self.generations += 1
        self.add(self.evaluator.evaluate(plans, source, rules))

    def _select_parents(self, candidates: EvaluatedPlans) -> NDArray[np.int64]:
        """Random rows of archive and front, at most POPULATION; plans of long episodes are selected less often."""
        archived = len(self.archive.lengths)
        from_front = self.rng.random(POPULATION) < FRONT_RATE
        first, last = np.where(from_front, archived, 0), np.where(from_front, len(candidates.lengths), archived)
        rows = self.rng.integers(first, last)
        rates = np.maximum(SHORT_EPISODE / candidates.lengths[rows], LEAST_PARENT_RATE)
        return rows[self.rng.random(POPULATION) < rates]

    def select_front(self, also: EvaluatedPlans | None = None) -> EvaluatedPlans:
        """The plans that make up the front, of those in the archive, on the front of before, and ``also``.

        The archive keeps one plan per box, and may have dropped one that adds more hypervolume.
        """
        candidates = self.archive.append(self.front)
        return select_front(candidates if also is None else candidates.append(also), self.references)

    def hypervolumes(self, evaluated: EvaluatedPlans) -> list[float]:
        """The hypervolume of plans for each of CRITERIA."""
        return [dominated_volume(*each) for each in zip(evaluated.returns, self.references, strict=True)]


def epsilon_nondominated(evaluated: EvaluatedPlans, objectives: Sequence[tuple[str, ...]]) -> NDArray[np.int64]:
    """Rows of the plans that the archive keeps.

    Args:
        evaluated: n plans.
        objectives: names of the d objectives, for each of CRITERIA.

    Returns:
        (m,) sorted rows: for each of CRITERIA, one plan of every box of returns that no other box dominates. In a box
        the greatest sum of scaled returns wins, then the shortest episode.
    """
    kept = []
    for returns, names in zip(evaluated.returns, objectives, strict=True):
        scaled = returns / scales(names)
        boxes = np.floor(scaled / EPSILON)
        order = np.lexsort((evaluated.lengths, -scaled.sum(axis=1)))
        _, best = np.unique(boxes[order], axis=0, return_index=True)
        rows = order[best]
        kept.append(rows[moocore.is_nondominated(boxes[rows], maximise=True)])
    return np.unique(np.concatenate(kept))


def dominated_volume(returns: NDArray[Any], reference: NDArray[Any]) -> float:
    """The hypervolume of ``returns`` (n, d) above ``reference`` (d,), maximised; 0 where no return dominates it."""
    return float(moocore.hypervolume(returns, ref=reference, maximise=True))


def greedy_hypervolume_subset(returns: NDArray[Any], reference: NDArray[Any], size: int) -> list[int]:
    """At most ``size`` rows of ``returns`` (n, d), each the one that adds most hypervolume to those before it.

    Rows that add nothing are not selected.
    """
    selected: list[int] = []
    volume = 0.0
    # Minus the contribution, the row, and how many rows were selected when the contribution was computed.
    queue = [(-dominated_volume(returns[[row]], reference), row, 0) for row in range(len(returns))]
    heapq.heapify(queue)
    while queue and len(selected) < size:
        loss, row, selected_then = heapq.heappop(queue)
        if loss >= 0.0:
            break
        if selected_then == len(selected):
            selected.append(row)
            volume -= loss
        else:
            loss = volume - dominated_volume(returns[[*selected, row]], reference)
            heapq.heappush(queue, (loss, row, len(selected)))
    return selected


def select_front(evaluated: EvaluatedPlans, references: Sequence[NDArray[Any]]) -> EvaluatedPlans:
    """The plans of a front.

    For each of CRITERIA, from the last to the first: the best plan of each objective, then those that add most
    hypervolume. Only plans that dominate the reference points of all CRITERIA are selected.

    Args:
        evaluated: n plans.
        references: a reference point (d,) for each of CRITERIA.

    Returns:
        The selected plans, the greatest discounted return of the first objective first.
    """
    pairs = zip(evaluated.returns, references, strict=True)
    dominating = [(returns >= reference).all(axis=1) for returns, reference in pairs]
    evaluated = evaluated.take(np.flatnonzero(np.all(dominating, axis=0)))
    rows: set[int] = set()
    for returns, reference, size in zip(evaluated.returns[::-1], references[::-1], FRONT_SIZES[::-1], strict=True):
        front = np.flatnonzero(moocore.is_nondominated(returns, maximise=True))
        rows |= set(front[returns[front].argmax(axis=0)].tolist())
        for row in front[greedy_hypervolume_subset(returns[front], reference, size)].tolist():
            if len(rows) < size:
                rows.add(row)
    selected = evaluated.take(np.array(sorted(rows)))
    return selected.take(np.lexsort(selected.returns[0].T[::-1])[::-1])
