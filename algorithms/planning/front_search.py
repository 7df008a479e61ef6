"""The evolutionary search for the front of one scenario and action set.

An archive-based evolutionary algorithm in the manner of epsilon-MOEA (Deb, Mohan and Mishra 2005): parents are drawn
from the archive, offspring enter it if no other plan epsilon-dominates them. Random driving rules make the first
generations and take over from some of the offspring later.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from algorithms.planning.archive import epsilon_nondominated
from algorithms.planning.driving_rules import random_rules
from algorithms.planning.plan_evaluation import PlanEvaluator
from algorithms.planning.plans import GAMMAS, EvaluatedPlans
from algorithms.planning.subset_selection import dominated_volume
from algorithms.planning.variation import make_offspring
from mo_deepdrive.reference_points import reference_point
from mo_deepdrive.scenarios import SCENARIOS

if TYPE_CHECKING:
    from numpy.typing import NDArray

POPULATION = 4096  # plans per generation
RULE_GENERATIONS = 5  # first generations, of rules only
TAKEOVER_RATE = 0.1  # share of the offspring that a rule takes over
# Long episodes cost time: above SHORT_EPISODE decisions a plan becomes a parent in inverse proportion to its length,
# but at least with probability LEAST_PARENT_RATE.
SHORT_EPISODE = 60
LEAST_PARENT_RATE = 0.2
UNKNOWN_SOURCE = -1


class FrontSearch:
    """A search for the front of one scenario and action set.

    Args:
        scenario: "one_waypoint" or "static_obstacle".
        action_type: "discrete", "discrete-16" or "continuous".
        seed: of all random choices.

    Attributes:
        references: the reference point (d,) of hypervolumes for each of GAMMAS.
        evaluator: simulates plans.
        archive: the plans that are kept; at first one that idles, of UNKNOWN_SOURCE.
        generations: evolved so far.
    """

    def __init__(self, scenario: str, action_type: str, seed: int):
        self.objectives = SCENARIOS[scenario].objectives
        self.references = [reference_point(scenario, action_type, gamma).values for gamma in GAMMAS]
        self.evaluator = PlanEvaluator(scenario, action_type)
        self.rng = np.random.default_rng(seed)
        self.generations = 0
        self.archive = self.evaluator.evaluate(self.evaluator.format.idle_plans(1), UNKNOWN_SOURCE)

    def add(self, evaluated: EvaluatedPlans) -> None:
        """Update the archive with plans."""
        candidates = self.archive.append(evaluated)
        self.archive = candidates.take(epsilon_nondominated(candidates, self.objectives))

    def evolve(self, source: int) -> None:
        """Make and evaluate one generation of plans and update the archive; ``source`` is the index of their source."""
        plan_format = self.evaluator.format
        rules = random_rules(POPULATION, self.rng, self.evaluator.batch)
        if self.generations < RULE_GENERATIONS:
            plans = plan_format.idle_plans(POPULATION)
        else:
            archive = self.archive
            parents, mates = self._select_parents(), self._select_parents()
            n = min(len(parents), len(mates))
            parents, mates, rules = parents[:n], mates[:n], rules[:n]
            plans = plan_format.idle_plans(n)
            make_offspring(
                archive.plans[parents],
                archive.lengths[parents],
                archive.plans[mates],
                archive.lengths[mates],
                plans,
                len(plan_format.table),
                plan_format.idle,
                self.rng,
            )
            taken_over = self.rng.random(n) < TAKEOVER_RATE
            takeovers = self.rng.random(n) * archive.lengths[parents]
            rules["first_decision"] = np.where(taken_over, takeovers, plan_format.decisions)
        self.generations += 1
        self.add(self.evaluator.evaluate(plans, source, rules))

    def _select_parents(self) -> NDArray[np.int64]:
        """Random rows of the archive, at most POPULATION; plans of long episodes are selected less often."""
        rows = self.rng.integers(len(self.archive.lengths), size=POPULATION)
        rates = np.maximum(SHORT_EPISODE / self.archive.lengths[rows], LEAST_PARENT_RATE)
        return rows[self.rng.random(POPULATION) < rates]

    def hypervolumes(self, evaluated: EvaluatedPlans) -> list[float]:
        """The hypervolume of plans for each of GAMMAS."""
        return [dominated_volume(*each) for each in zip(evaluated.returns, self.references, strict=True)]
