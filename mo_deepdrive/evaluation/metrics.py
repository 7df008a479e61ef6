"""Every metric's name, written once, and the summary of episodes of training.

A column of ``metrics.csv`` is named ``PREFIX [VEHICLE/] METRIC``, as in ``eval/greedy/vehicle_0/return/jerk``:

``train/``
    means over the episodes that ended since the last row;
``eval/greedy/``, ``eval/stochastic/``, ``eval/front/``
    an evaluation of the policy that takes the most likely (or mean) action, of the policy that samples, and of the
    front that a multi-policy algorithm has found;
``loss/``, ``policy/``, ``time/``
    the updates.

Final evaluations are named in the same way without ``eval/``. ``VEHICLE/`` is there with several vehicles only.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mo_deepdrive.simulation.state import ENDS
from mo_deepdrive.support.names import nearest
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

# ------------------------------------------------------------------------------------------------------------- names

STEP = "step"  # column of metrics.csv: environment steps taken

TRAIN, EVALUATION = "train/", "eval/"
GREEDY, STOCHASTIC, FRONT = "greedy", "stochastic", "front"
POLICIES = (GREEDY, STOCHASTIC, FRONT)

# Of episodes: expected scalarised return (ESR: mean utility) and scalarised expected return (SER: utility of the mean).
UTILITY = "utility"
UTILITY_ESR, UTILITY_SER = "utility_esr", "utility_ser"
DISCOUNTED_UTILITY_ESR, DISCOUNTED_UTILITY_SER = "discounted_utility_esr", "discounted_utility_ser"
TOTAL_UTILITY_ESR = "total_utility_esr"  # sum over the vehicles
WORST_OFF_UTILITY_ESR = "worst_off_utility_esr"  # mean over episodes of the least one among the vehicles
GINI_UTILITY_ESR = "gini_utility_esr"  # mean over episodes of the sum that counts the worse-off for more
# Means over the vehicles: of those that arrive, of those that collide, and of their utilities.
SHARE_ARRIVED, SHARE_COLLIDED, MEAN_UTILITY_ESR = "share_arrived", "share_collided", "mean_utility_esr"
SUCCESS, LENGTH = "success", "length"
RETURN, DISCOUNTED_RETURN, END = "return/", "discounted_return/", "end/"

# Of a task of the suite: the score, and beside it those under perturbations and so on.
SUITE = "suite/"
SUITE_SCORE = SUITE + "score"

# Of fronts.
HYPERVOLUME, CARDINALITY, EXPECTED_UTILITY = "hypervolume", "cardinality", "expected_utility"
IGD_PLUS, ADDITIVE_EPSILON = "igd_plus", "additive_epsilon"
LOWEST_DISTANCE, HIGHEST_DISTANCE = "lowest_distance", "highest_distance"  # returns of the policies of a front

# Of updates.
POLICY_LOSS, VALUE_LOSS = "loss/policy", "loss/value"
LEARNING_RATE = "policy/learning_rate"
ENTROPY, ENTROPY_COEFFICIENT = "policy/entropy", "policy/entropy_coefficient"
CLIP_FRACTION, APPROX_KL = "policy/clip_fraction", "policy/approx_kl"
MULTIPLIER, RUNNING_COST = "policy/multiplier/", "policy/running_cost/"  # of an objective with a rule
COMMAND_ERROR, NON_DOMINATED = "policy/command_error", "policy/non_dominated"
STEPS_PER_SECOND = "time/steps_per_second"

# Objectives that are rates, whose magnitudes per decision are reported too.
COMFORT = ("g_force", "jerk")
# Reasons why an episode ends: arriving, and the failures that are reported even where none occurred.
ARRIVED, COLLISION, OFF_LANE, TIME_LIMIT = "arrived", "collision", "off_lane", "time_limit"
USUAL_FAILURES = (COLLISION, OFF_LANE, TIME_LIMIT)
OUR_ENDS = frozenset(ENDS) - {""}  # all reasons of this package's environments


def evaluation_prefix(policy: str) -> str:
    """``eval/greedy/`` of one of :data:`POLICIES`."""
    return f"{EVALUATION}{policy}/"


def vehicle_name(v: int) -> str:
    """``vehicle_0``."""
    return f"vehicle_{v}"


def vehicle_prefix(v: int, vehicles: int) -> str:
    """``vehicle_0/`` where there are several ``vehicles``; nothing for the only one."""
    return f"{vehicle_name(v)}/" if vehicles > 1 else ""


def joint_objectives(objectives: Sequence[str], vehicles: int) -> tuple[str, ...]:
    """The objectives of each of several vehicles in turn, such as ``vehicle_1/jerk``; unchanged for a single one."""
    return tuple(vehicle_prefix(v, vehicles) + name for v in range(vehicles) for name in objectives)


def without_vehicle(objective: str) -> str:
    """The objective of which a joint one is that of a vehicle: ``jerk`` for ``vehicle_1/jerk``."""
    vehicle, _, name = objective.rpartition("/")
    return name if re.fullmatch(r"vehicle_\d+", vehicle) else objective


def return_of(objective: str) -> str:
    """The undiscounted return of an objective: ``return/jerk``."""
    return RETURN + objective


def discounted_return_of(objective: str) -> str:
    """The discounted return of an objective: ``discounted_return/jerk``."""
    return DISCOUNTED_RETURN + objective


def end_by(reason: str) -> str:
    """The share of episodes that end for a reason: ``end/collision``."""
    return END + reason


def mean_of(objective: str) -> str:
    """The mean magnitude of an objective per decision: ``mean_jerk``."""
    return f"mean_{objective}"


def maximum_of(objective: str) -> str:
    """The largest magnitude of an objective in one decision: ``max_jerk``."""
    return f"max_{objective}"


class MetricName(NamedTuple):
    """The parts of a metric's name; "" for the policy and the vehicle where none is named."""

    policy: str
    vehicle: str
    metric: str


def split_name(name: str) -> MetricName:
    """``greedy/vehicle_0/return/jerk`` as ``("greedy", "vehicle_0", "return/jerk")``, with or without ``eval/``."""
    policy, slash, rest = name.removeprefix(EVALUATION).partition("/")
    if not slash or policy not in POLICIES:
        policy, rest = "", name.removeprefix(TRAIN)
    vehicle, slash, metric = rest.partition("/")
    if not slash or not vehicle.startswith("vehicle_"):
        vehicle, metric = "", rest
    return MetricName(policy, vehicle, metric)


def known_metric(name: str, available: Iterable[str]) -> str:
    """``name``, if it is one of the ``available`` metrics; else a ValueError with the nearest one."""
    names = list(available)
    if name in names:
        return name
    raise ValueError(f"metric {name!r} is not among those of the runs; {nearest(name, names)}")


# ----------------------------------------------------------------------------------------------------------- meanings

_LOWER_IS_BETTER = frozenset(
    (
        LENGTH,
        IGD_PLUS,
        ADDITIVE_EPSILON,
        COMMAND_ERROR,
        SHARE_COLLIDED,
        *(mean_of(objective) for objective in COMFORT),
        *(maximum_of(objective) for objective in COMFORT),
    )
)
_TITLES = {
    UTILITY: "utility per episode",
    UTILITY_ESR: "utility per episode",
    SUCCESS: "arrival rate",
    HYPERVOLUME: "hypervolume",
    CARDINALITY: "policies of the front",
    EXPECTED_UTILITY: "expected utility, 50 weights",
    IGD_PLUS: "IGD+ to the best-known front",
}


def lower_is_better(name: str) -> bool:
    """Whether less of a metric is better; returns are rewards, of which more is better, costs included."""
    metric = split_name(name).metric
    if metric.startswith(END):
        return metric != end_by(ARRIVED)
    return metric in _LOWER_IS_BETTER or metric.startswith("loss/")


def title_of(name: str) -> str:
    """The display name of a metric in figures: "arrival rate", "jerk (sum, m/s³)"."""
    metric = split_name(name).metric
    if metric.startswith(RETURN):
        objective = metric.removeprefix(RETURN)
        return label(objective) if objective in INDEX else objective.replace("_", " ")
    if metric.startswith(END) and metric not in _TITLES:
        return f"{_plain(metric.removeprefix(END))} rate"
    return _TITLES.get(metric) or _plain(metric)


def name_and_unit(objective: str) -> tuple[str, str]:
    """The plain name of an objective and the unit of its return; an unknown objective has no unit ("")."""
    name = without_vehicle(objective)
    if name not in INDEX:
        return objective, ""
    unit = OBJECTIVES[INDEX[name]].unit
    return _plain(objective.replace("/", ": ")), "" if unit == "1" else unit.replace("^2", "²").replace("^3", "³")


def _plain(name: str) -> str:
    return name.replace("_", " ").replace("g force", "g-force")


def label(objective: str, how: str = "sum") -> str:
    """The plain name of an objective and, where it has a unit, how its return adds up: "jerk (sum, m/s³)"."""
    name, unit = name_and_unit(objective)
    return f"{name} ({how}, {unit})" if unit else name


# ------------------------------------------------------------------------------------------------- summary of episodes


def end_rates(ends: NDArray[Any]) -> dict[str, float]:
    """The share of episodes per reason of their end, by reason; of ``ends`` (E,) None stands for an unknown one.

    Only reasons that occurred; of this package's environments all that there are, so that a curve falls to 0 when a
    reason occurs no more.
    """
    counts = Counter(str(end) for end in ends if end is not None)
    reasons = set(counts)
    if reasons and reasons <= OUR_ENDS:
        reasons = set(OUR_ENDS)
    return {reason: counts[reason] / len(ends) for reason in sorted(reasons)}


def summarise(
    objectives: Sequence[str],
    returns: NDArray[np.float64],
    lengths: NDArray[Any],
    succeeded: NDArray[Any],
    utility: Callable[[Any], Any] | None = None,
) -> dict[str, float]:
    """Means over E episodes (at least 1) of one vehicle in training, by metric without prefix.

    Returns are (E, d), undiscounted; lengths and successes (E,); the utility maps returns (..., d), and None is
    unknown.
    """
    summary: dict[str, float] = {}
    if utility is not None:
        summary[UTILITY] = float(np.mean(utility(returns)))
    summary[SUCCESS] = float(np.mean(succeeded))
    summary[LENGTH] = float(np.mean(lengths))
    return summary | {return_of(name): float(mean) for name, mean in zip(objectives, returns.mean(axis=0), strict=True)}
