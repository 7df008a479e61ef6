"""Evaluation of plans: their episodes in the compiled simulation, a whole generation in one call."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from mo_deepdrive.fronts.reference_fronts import front_config
from mo_deepdrive.simulation import observation, traffic
from mo_deepdrive.simulation.actions import decode_continuous, decode_discrete
from mo_deepdrive.simulation.dynamics import make_scratch
from mo_deepdrive.simulation.kernel import step_worlds
from mo_deepdrive.simulation.state import RUNNING
from mo_deepdrive.world.batch import WorldBatch
from mo_deepdrive.world.observation import layout
from scripts.bounds.driving_rules import RULE, follow_rule
from scripts.bounds.plans import CRITERIA, FULL_SCALE, EvaluatedPlans, PlanFormat, Plans

if TYPE_CHECKING:
    from numpy.typing import NDArray


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
    weights: NDArray[Any],
    returns: NDArray[Any],
    lengths: NDArray[Any],
) -> None:
    """Simulate one plan in each world until its episode ends.

    Args:
        worlds: (n, 1) of VEHICLE at their starts, changed in place.
        plans: (n, decisions, k) int16; the actions of rules are written.
        rules: (n,) of RULE.
        table: (actions, 4) of a discrete action set; empty for a continuous one.
        params: (1,) of PARAMS.
        motion: scratch, from make_scratch.
        cars: scratch, from traffic.make_scratch.
        path: as motion.
        sight: (1,) of SIGHT, scratch.
        seen: (n, 1, size) float32, scratch for observations.
        controls: (n, 1, 3) scratch.
        weights: (criteria, decisions) discount of each decision.
        returns: (criteria, n, d), added to.
        lengths: (n,), written: decisions until the episode ended.
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
            for k in range(params[0].n_objectives):
                value = params[0].objective_sign[k] * vehicle.objectives[params[0].objective_index[k]]
                for g in range(len(weights)):
                    returns[g, i, k] += weights[g, t] * np.float32(value)
            if vehicle.end != RUNNING:
                lengths[i] = t + 1
                break


class PlanEvaluator:
    """Evaluates plans in the scenario of a best-known front, which is the same in every episode.

    Args:
        scenario: "one_waypoint" or "static_obstacle".
        action_type: "discrete", "discrete-16" or "continuous".
        time_limit: seconds after which an episode ends; the environment's by default.

    Attributes:
        batch: one world at the start of the scenario.
        format: of the plans.
        simulated_decisions: decisions simulated so far.
    """

    def __init__(self, scenario: str, action_type: str, time_limit: float | None = None):
        config = front_config(scenario, action_type)
        if time_limit is not None:
            config = config.model_copy(update={"time_limit": time_limit})
        self.batch = WorldBatch(config, 1)
        self.batch.place()
        self.format = PlanFormat(action_type, config.max_decisions)
        self.simulated_decisions = 0
        motion, path = make_scratch(1, config.physics_steps)
        self._scratch = (motion, traffic.make_scratch(0), path, np.zeros(1, dtype=observation.SIGHT))
        self._observed = len(layout(self.batch.scenario))
        self._weights = np.array([criterion.gamma ** np.arange(config.max_decisions) for criterion in CRITERIA])
        params = self.batch.params[0]
        # (criteria, decisions) the time until after each decision, discounted.
        self._times = self._weights.cumsum(axis=1) * (params["dt"] * params["physics_steps"])

    def evaluate(self, plans: Plans, source: int, rules: NDArray[Any] | None = None) -> EvaluatedPlans:
        """Simulate the episodes of plans.

        Args:
            plans: (n, decisions, k), changed in place: the actions of rules are written, and idle actions after the
                end of an episode.
            source: index of what found the plans.
            rules: (n,) of RULE, each of which replaces its plan from its ``first_decision`` on; None for no rules.
        """
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
