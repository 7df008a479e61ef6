"""Utility functions, which map a vector return to a scalar.

A utility takes returns (or rewards) of shape (..., d) with the signs of the environment's rewards, as a NumPy array or
a torch tensor, and returns shape (...) of the same type, differentiable where the function is. The paper defines its
utilities on magnitudes (appendix D); :func:`make_utility` converts the signs.

To add a utility, write a function of magnitudes (or of returns) and add a row to the tables below. A custom utility is
given by its path, ``package.module:function``.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from mo_deepdrive.simulation.state import GRAVITY
from mo_deepdrive.support.faults import NotFinite
from mo_deepdrive.support.importing import import_named
from mo_deepdrive.support.names import nearest
from mo_deepdrive.support.plain_values import finite_numbers, is_finite
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES

Function = Callable[[Any], Any]


class Utility:
    """A named utility over d objectives, which can be pickled if its function can; all of :func:`make_utility` can.

    Attributes:
        name: the registered name or the path.
        objectives: names of the d components of its argument, in order.
        weights: (d,) weights of the returns if the utility is linear, else None.
        arguments: with which :func:`make_utility` made it; None if it is made of a function.
    """

    def __init__(
        self, name: str, objectives: Sequence[str], function: Function, weights: Sequence[float] | None = None
    ):
        self.name = name
        self.objectives = tuple(objectives)
        self.weights = None if weights is None else tuple(float(w) for w in weights)
        self.arguments: Mapping[str, Any] | None = None
        self._function = function
        self._checked = True

    def __call__(self, returns: Any) -> Any:
        """Utility of ``returns`` (..., d): shape (...).

        Raises:
            ValueError: if the length of the last axis is not d.
            NotFinite: naming the utility and the return, if a utility is not finite.
        """
        if returns.ndim == 0 or returns.shape[-1] != len(self.objectives):
            raise ValueError(
                f"utility {self.name!r} takes {len(self.objectives)} objectives {self.objectives}; "
                f"the returns have {returns.shape[-1] if returns.ndim else 'no axis'}"
            )
        with np.errstate(all="ignore"):  # what is not finite is refused
            values = self._function(_real(returns))
        if self._checked:
            self._check_finite(returns, values)
        return values

    def unchecked(self) -> Utility:
        """The same without a check that utilities are finite, for which a GPU would have to be waited for."""
        utility = copy.copy(self)
        utility._checked = False
        return utility

    def _check_finite(self, returns: Any, values: Any) -> None:
        try:
            wrong = ~np.isfinite(_array(values))
        except TypeError:  # not numbers, as check_utility says
            return
        if wrong.shape == returns.shape[:-1] and wrong.any():
            at = tuple(np.argwhere(wrong)[0])
            given = dict(zip(self.objectives, _array(returns)[at].tolist(), strict=True))
            raise NotFinite(f"utility {self.name!r} = {_array(values)[at]} for the return {given}; it must be finite")


def _array(values: Any) -> Any:
    return values.detach().cpu().numpy() if hasattr(values, "detach") else np.asarray(values)


def _real(returns: Any) -> Any:
    """Integers as floats, so that weights are not rounded to the type of the returns."""
    if isinstance(returns, np.ndarray):
        return returns if returns.dtype.kind == "f" else returns.astype(np.float64)
    return returns if returns.is_floating_point() else returns.double()


def _where(condition: Any, first: Any, second: Any) -> Any:
    if isinstance(condition, (np.ndarray, np.bool_)):
        return np.where(condition, first, second)
    import torch

    return torch.where(condition, first, second)


def _one_waypoint_nonlinear(m: dict[str, Any]) -> Any:
    d, r, g, j = m["distance"], m["destination"], m["g_force"], m["jerk"]
    fast = 0.5 * d + d * r - 0.1 * g - 0.1 * j
    slow = 0.5 * d + r - (0.1 * g) ** 2 - (0.1 * j) ** 2
    return _where(d > 2.0, fast, slow)


def _obstacle_nonlinear(m: dict[str, Any]) -> Any:
    d, r, g, c, j = m["distance"], m["destination"], m["g_force"], m["collision"], m["jerk"]
    gain = 0.5 * d + r - 4.0 * c
    retreat = gain - (0.03 * g) ** 4 - (3.3e-5 * j) ** 4
    advance = gain - 2.0 * (0.03 * g) ** 2
    return _where(d == 0.0, 0.0 * d - 10.0, _where(d < 0.0, retreat, advance))


def _intersection_nonlinear(m: dict[str, Any]) -> Any:
    lane = 0.06 * m["lane_violation"]
    at_rest = m["distance"] == 0.0
    base = _obstacle_nonlinear(m)
    return _where(at_rest, base, base - lane)


@dataclass(frozen=True)
class ComfortBudget:
    """The numbers of a comfort budget, for magnitudes of an episode."""

    GAINS: ClassVar[dict[str, float]] = {"distance": 0.1, "destination": 10.0}

    g_force: float  #: budget of the sum of the g-forces (g)
    jerk: float  #: budget of the sum of the jerks (m/s^3)
    prices: Mapping[str, float] = field(default_factory=dict)  #: per unit of other costs
    #: Per unit of what exceeds a budget.
    excess_prices: Mapping[str, float] = field(default_factory=lambda: {"g_force": 2.0, "jerk": 0.05})

    def utility(self, m: dict[str, Any]) -> Any:
        """0.1 d + 10 r - 2 max(0, G - g_force) - 0.05 max(0, J - jerk) - prices of other costs, by default."""
        value = sum(gain * m[objective] for objective, gain in self.GAINS.items())
        for objective, price in self.excess_prices.items():
            value = value - price * _excess(m[objective], getattr(self, objective))
        for objective, price in self.prices.items():
            value = value - price * m[objective]
        return value


def _excess(magnitude: Any, budget: float) -> Any:
    return _where(magnitude > budget, magnitude - budget, 0.0 * magnitude)


def _at_most_one(values: Any) -> Any:
    return _where(values < 1.0, values, 0.0 * values + 1.0)


def _one_waypoint_satisficing(m: dict[str, Any]) -> Any:
    short = 2.0 * _excess(m["g_force"], 4.0) + _excess(m["jerk"], 30.0) / 5.0 + _excess(m["time"], 12.0)
    return m["destination"] * (2.0 + 8.0 * (1.0 - _at_most_one(short)))


def _one_waypoint_deadline(m: dict[str, Any]) -> Any:
    late = m["time"] > 40.0
    return 0.1 * m["distance"] + 10.0 * _where(late, 0.0 * m["time"], m["destination"]) - m["energy"]


@dataclass(frozen=True)
class RiskAversion:
    """Constant absolute risk aversion in a linear value L of magnitudes: T (1 - exp(-L / T)).

    J. W. Pratt, "Risk aversion in the small and in the large", Econometrica 32, 1964.
    """

    weights: Mapping[str, float]  #: of L, by objective
    #: T, in the units of L. R. A. Howard ("Decision analysis: practice and promise", Management Science 34, 1988) reads
    #: it as the stake x for which an even chance to win x or lose x / 2 is hardly worth taking.
    tolerance: float

    def utility(self, m: dict[str, Any]) -> Any:
        """The utility of an episode."""
        total = sum(weight * m[objective] for objective, weight in self.weights.items())
        return self.tolerance * (1.0 - math.e ** (-total / self.tolerance))

    def certainty_equivalent(self, utility: Any) -> Any:
        """The L that is worth ``utility`` when it is certain: of an episode its own L, of a mean less than the mean."""
        return -self.tolerance * np.log1p(-utility / self.tolerance)


# Limits of comfort of nuPlan (H. Caesar et al., "nuPlan: a closed-loop ML-based planning benchmark for autonomous
# vehicles", arXiv:2106.11810, 2021, in its metrics): longitudinal acceleration of at least -4.05 m/s^2, and jerk.
COMFORTABLE_BRAKING = 4.05  # m/s^2
COMFORTABLE_JERK = 8.37  # m/s^3

_INTERSECTION = {
    **{"distance": 0.5, "destination": 10.0, "collision": -4.0},
    **{"g_force": -0.03, "jerk": -0.0006, "lane_violation": -0.06},
}
# Linear utilities: weights of the magnitudes. Those of the first three scenarios are the paper's.
LINEAR: dict[str, dict[str, float]] = {
    "one_waypoint_linear": {"distance": 0.5, "destination": 1.0, "g_force": -0.03, "jerk": -3.3e-5},
    "static_obstacle_linear": {
        **{"distance": 0.3, "destination": 1.0, "collision": -1.0},
        **{"g_force": -0.03, "jerk": -3.3e-5},
    },
    "intersection_linear": _INTERSECTION,
    # A second costs a tenth of an arrival: where time is free, a driver who waits until everybody must have gone is the
    # best, and needs to see nobody.
    "intersection_hurried": {**_INTERSECTION, "time": -1.0},
    # A collision costs as much as an arrival gives, so that it is worse than never arriving. A second costs 0.1:
    # waiting for one more gap (4.5 s in the mean) is worth two collisions in a hundred episodes (2% of 10 for the
    # collision and of 10 for the arrival forgone), and even the 60 s of the time limit (6) cost less than an arrival
    # gives.
    "left_turn_linear": {**_INTERSECTION, "collision": -10.0, "time": -0.1},
    # The way there pays as much as getting there: 0.1 per metre of about 100. Prices of collisions, lanes and time are
    # those of left_turn_linear. A decision on a limit of comfort costs 0.02, and forcing somebody to brake on it for a
    # second 2; a near miss, which is below nuPlan's least time to collision of 0.95 s, costs 0.5.
    "roundabout_linear": {
        "distance": 0.1,
        "destination": 10.0,
        "time": -0.1,
        "g_force": -0.02 / (COMFORTABLE_BRAKING / GRAVITY),
        "jerk": -0.02 / COMFORTABLE_JERK,
        "lane_violation": -0.06,
        "collision": -10.0,
        "near_miss": -0.5,
        "right_of_way": -2.0 / COMFORTABLE_BRAKING,
        "energy": -0.01,
    },
}

# The first tolerance is what an arrival gives: from an early collision to an arrival a unit's worth falls about
# twentyfold (e^3). In the second a second costs a tenth of an arrival, and a collision, which is charged all the time
# that is left, loses nearly 70: with twice the tolerance one in a thousand episodes weighs about as much as a second.
# Its prices of comfort and lanes are those of left_turn_linear.
RISK_AVERSE: dict[str, RiskAversion] = {
    "left_turn_risk_averse": RiskAversion(LINEAR["left_turn_linear"], tolerance=10.0),
    "left_turn_hurried_risk_averse": RiskAversion(
        {**LINEAR["left_turn_linear"], "distance": 0.3, "time": -1.0}, tolerance=20.0
    ),
}

# An arrival gives 10, a metre 0.1, so that the way there pays, but less than getting there. 5 g or 200 m/s^3 beyond the
# budget cost an arrival. Budgets are nine tenths of what is spent without one, so that they bind: by policies for the
# paper's linear utility in OneWaypoint (5.5 g and 45 m/s^3) and StaticObstacle (7.9 and 124), and in LeftTurn by the
# fixed rule that waits for a gap of 5 s (14.2 and 205). Other prices are those of left_turn_linear.
COMFORT_BUDGETS: dict[str, ComfortBudget] = {
    "one_waypoint_comfort_budget": ComfortBudget(g_force=5.0, jerk=40.0),
    "static_obstacle_comfort_budget": ComfortBudget(g_force=7.0, jerk=110.0, prices={"collision": 10.0}),
    "left_turn_comfort_budget": ComfortBudget(
        g_force=13.0, jerk=185.0, prices={"collision": 10.0, "lane_violation": 0.06, "time": 0.1}
    ),
    # Tighter, and dearer beyond: here a linear price of comfort cannot recover what is best.
    "static_obstacle_tight_budget": ComfortBudget(
        5.0, 60.0, prices={"collision": 10.0, "time": 0.2}, excess_prices={"g_force": 5.0, "jerk": 0.2}
    ),
}

BUDGETS = ("g_force", "jerk")  # the arguments of a comfort budget

# Non-linear utilities: the objectives that each needs, and its formula in magnitudes. The first three are the paper's.
NONLINEAR: dict[str, tuple[tuple[str, ...], Callable[[dict[str, Any]], Any]]] = {
    "one_waypoint_nonlinear": (("distance", "destination", "g_force", "jerk"), _one_waypoint_nonlinear),
    "static_obstacle_nonlinear": (("distance", "destination", "g_force", "collision", "jerk"), _obstacle_nonlinear),
    "intersection_nonlinear": (
        ("distance", "destination", "g_force", "collision", "jerk", "lane_violation"),
        _intersection_nonlinear,
    ),
    # An arrival within limits of g-force, jerk and time pays five times as much as one beyond them.
    "one_waypoint_satisficing": (("destination", "g_force", "jerk", "time"), _one_waypoint_satisficing),
    # An arrival is worth something until 40 s have passed, of which a part may have been spent before.
    "one_waypoint_deadline": (("distance", "destination", "energy", "time"), _one_waypoint_deadline),
    **{name: (tuple(risk.weights), risk.utility) for name, risk in RISK_AVERSE.items()},
    **{
        name: (("distance", "destination", "g_force", "jerk", *budget.prices), budget.utility)
        for name, budget in COMFORT_BUDGETS.items()
    },
}


def _in_order(name: str, argument: str, values: Any, objectives: Sequence[str], missing: float | None = None) -> Any:
    """Values by the names of objectives as a list in their order; anything else as it is.

    A ValueError for an unknown name, or one without a value where ``missing`` is None.
    """
    if not isinstance(values, Mapping):
        return values
    for each in values:
        if each not in objectives:
            raise ValueError(f"{argument} of utility {name!r} has {each!r}; {nearest(each, objectives)}")
    absent = [objective for objective in objectives if objective not in values]
    if absent and missing is None:
        raise ValueError(f"{argument} = {dict(values)} of utility {name!r} has no number for {', '.join(absent)}")
    return [values.get(objective, missing) for objective in objectives]


def _vector(name: str, argument: str, values: Any, d: int) -> list[float]:
    if values is None:
        raise ValueError(f"utility {name!r} needs the argument {argument!r}: {d} numbers")
    numbers = finite_numbers(values)
    if numbers is None or numbers.shape != (d,):
        raise ValueError(f"{argument} = {values!r} must be {d} finite numbers for utility {name!r}")
    return [float(number) for number in numbers]


def _like(values: list[float], returns: Any) -> Any:
    if isinstance(returns, np.ndarray):
        return np.asarray(values, dtype=returns.dtype)
    return _constant(tuple(values), returns.dtype, returns.device)


@lru_cache
def _constant(values: tuple[float, ...], dtype: Any, device: Any) -> Any:
    """A tensor that is on its device already where an update is captured as a CUDA graph."""
    import torch

    with torch.inference_mode(False):  # it may be needed for a gradient later
        return torch.tensor(values, dtype=dtype, device=device)


def _weighted_sum(w: list[float], returns: Any) -> Any:
    return (returns * _like(w, returns)).sum(-1)


def linear(objectives: Sequence[str], weights: Any = None) -> Utility:
    """sum_i w_i R_i, with weights w (d,), or by the names of objectives (0 for those that are not named)."""
    w = _vector("linear", "weights", _in_order("linear", "weights", weights, objectives, 0.0), len(objectives))
    return Utility("linear", objectives, partial(_weighted_sum, w), w)


def _chebyshev(w: list[float], z: list[float], rho: float, returns: Any) -> Any:
    gaps = _like(w, returns) * (_like(z, returns) - returns)
    worst = gaps.max(-1) if isinstance(gaps, np.ndarray) else gaps.amax(-1)
    return -(worst + rho * gaps.sum(-1))


def augmented_chebyshev(
    objectives: Sequence[str], weights: Any = None, ideal: Any = None, rho: float = 0.05
) -> Utility:
    """-(max_i w_i (z_i - R_i) + rho sum_i w_i (z_i - R_i)), with ideal point z (Steuer and Choo 1983).

    Weights and ideal point are (d,) or by the names of objectives; weights that are not named are 0.
    """
    name, d = "augmented_chebyshev", len(objectives)
    w = _vector(name, "weights", _in_order(name, "weights", weights, objectives, 0.0), d)
    z = _vector(name, "ideal", _in_order(name, "ideal", ideal, objectives), d)
    if not is_finite(rho) or rho < 0:
        raise ValueError(f"rho = {rho!r} must be finite and not negative")
    return Utility("augmented_chebyshev", objectives, partial(_chebyshev, w, z, float(rho)))


def _gini(w: list[float], s: list[float], returns: Any) -> Any:
    scaled = returns / _like(s, returns)
    ordered = np.sort(scaled, axis=-1) if isinstance(scaled, np.ndarray) else scaled.sort(-1).values
    return (ordered * _like(w, returns)).sum(-1)


def generalised_gini(objectives: Sequence[str], weights: Any = None, scales: Any = None) -> Utility:
    """sum_i w_i (R / s)_(i), components in increasing order, with non-increasing weights w (Weymark 1981).

    The weights (d,) belong to ranks; the scales (d,) may be given by the names of objectives (1 for those not named).
    """
    name, d = "generalised_gini", len(objectives)
    w = _vector(name, "weights", weights, d)
    s = _vector(name, "scales", _in_order(name, "scales", {} if scales is None else scales, objectives, 1.0), d)
    if any(later > earlier for earlier, later in pairwise(w)) or w[-1] < 0.0:
        raise ValueError(f"weights = {w} of generalised_gini must be non-increasing and non-negative")
    if any(scale <= 0.0 for scale in s):
        raise ValueError(f"scales = {s} of generalised_gini must be positive")
    return Utility("generalised_gini", objectives, partial(_gini, w, s))


STANDARD: dict[str, Callable[..., Utility]] = {
    "linear": linear,
    "augmented_chebyshev": augmented_chebyshev,
    "generalised_gini": generalised_gini,
}
UTILITIES: tuple[str, ...] = (*LINEAR, *NONLINEAR, *STANDARD)


def make_utility(name: str, objectives: Sequence[str], cost_sign: str = "maximise", **arguments: Any) -> Utility:
    """The utility ``name`` for an environment with the given objectives.

    Args:
        name: one of UTILITIES, or the path ``package.module:function`` of a function that maps returns (..., d), with
            the signs of the environment's rewards, to (...).
        objectives: names of the components of the environment's reward, in order. Those that a named utility is not
            defined for weigh nothing.
        cost_sign: the environment's setting: "maximise" or "paper".
        **arguments: arguments of the utility, for example ``weights``; of a comfort budget ``g_force`` and ``jerk``.

    Raises:
        ValueError: for an unknown name, missing objectives or invalid arguments.
    """
    utility = _make_utility(name, tuple(objectives), cost_sign, arguments)
    utility.arguments = arguments
    return utility


def _make_utility(name: str, objectives: tuple[str, ...], cost_sign: str, arguments: dict[str, Any]) -> Utility:
    if cost_sign not in ("maximise", "paper"):
        raise ValueError(f"cost_sign = {cost_sign!r} must be 'maximise' or 'paper'")
    if ":" in name:
        return Utility(name, objectives, _Named(name, arguments))
    if name in STANDARD:
        try:
            utility = STANDARD[name](objectives, **arguments)
        except TypeError as error:
            raise ValueError(f"utility {name!r}: {error}") from None
        if cost_sign == "maximise":
            _warn_of_rewarded_costs(utility)
        return utility
    if name not in LINEAR and name not in NONLINEAR:
        raise ValueError(f"utility {name!r} is unknown; {nearest(name, UTILITIES)}; or package.module:function")
    budget = _with_budgets(name, arguments) if name in COMFORT_BUDGETS else None
    if arguments and budget is None:
        raise ValueError(f"utility {name!r} takes no arguments; got {sorted(arguments)}")
    needed = tuple(LINEAR[name]) if name in LINEAR else NONLINEAR[name][0]
    if absent := [objective for objective in needed if objective not in objectives]:
        raise ValueError(f"utility {name!r} needs {', '.join(absent)}; the environment has {objectives}")
    paper = cost_sign == "paper"
    signs = {objective: 1.0 if paper else float(OBJECTIVES[INDEX[objective]].sign) for objective in needed}
    if name in LINEAR:
        weights = [LINEAR[name][each] * signs[each] if each in signs else 0.0 for each in objectives]
        return Utility(name, objectives, partial(_weighted_sum, weights), weights)
    formula = NONLINEAR[name][1] if budget is None else budget.utility
    columns = {each: (objectives.index(each), sign) for each, sign in signs.items()}
    return Utility(name, objectives, partial(_of_magnitudes, formula, columns))


def _of_magnitudes(
    formula: Callable[[dict[str, Any]], Any], columns: dict[str, tuple[int, float]], returns: Any
) -> Any:
    # Of a single return, too, the magnitudes are arrays: NumPy's powers of scalars have other last bits.
    magnitudes = {objective: returns[..., i, None] * sign for objective, (i, sign) in columns.items()}
    return formula(magnitudes)[..., 0][()]


def _warn_of_rewarded_costs(utility: Utility) -> None:
    """Warn of negative weights of costs, whose returns are negative already."""
    for objective, weight in zip(utility.objectives, utility.weights or (), strict=False):
        if weight < 0.0 and objective in INDEX and OBJECTIVES[INDEX[objective]].sign < 0:
            message = f"weight of {objective!r} = {weight} rewards a cost: its returns are negative already"
            warnings.warn(message, stacklevel=3)


def _with_budgets(name: str, budgets: Mapping[str, Any]) -> ComfortBudget:
    """The comfort budget ``name``, with other numbers for the budgets that are given; others are ValueErrors."""
    for each, value in budgets.items():
        if each not in BUDGETS:
            raise ValueError(f"utility {name!r} takes no arguments but {', '.join(BUDGETS)}; got {each!r}")
        if not is_finite(value) or value < 0:
            raise ValueError(f"{each} = {value!r} of utility {name!r} must be finite and at least 0")
    numbers: dict[str, Any] = {each: float(value) for each, value in budgets.items()}
    return replace(COMFORT_BUDGETS[name], **numbers)


def fitting_utility(
    utility: str | Utility,
    objectives: Sequence[str],
    cost_sign: str = "maximise",
    *,
    named: bool = True,
    **arguments: Any,
) -> Utility:
    """A utility, by its name or as it is, for an environment; objectives that are ``named`` must be the same.

    Errors are those of :func:`make_utility`, or a ValueError if the utility takes other objectives.
    """
    if isinstance(utility, str):
        return make_utility(utility, objectives, cost_sign, **arguments)
    if arguments:
        raise ValueError(f"arguments {sorted(arguments)} are for a utility given by name")
    if utility.objectives != tuple(objectives) and (named or len(utility.objectives) != len(objectives)):
        has = f"the environment has {tuple(objectives)}, in this order"
        raise ValueError(f"utility {utility.name!r} takes {utility.objectives}; {has}")
    return utility


def check_utility(utility: Utility, zeros: Callable[[tuple[int, ...]], Any]) -> None:
    """Call a utility with returns of every number of axes: of a mean, of episodes, and of steps of episodes.

    A user's function may be written for one of them alone, and would otherwise fail when another is first needed. The
    returns are those of ``numpy.zeros`` or ``torch.zeros``. A ValueError names the utility and the shape, if the call
    fails or does not give one finite number per return.
    """
    d = len(utility.objectives)
    for shape in ((d,), (2, d), (3, 2, d)):
        returns = zeros(shape)
        library = type(returns).__module__
        given = f"returns of shape {shape} as {library}"
        try:
            values = utility(returns)
        except NotFinite as error:
            raise ValueError(str(error)) from None
        except Exception as error:
            message = " ".join(str(error).split())
            raise ValueError(f"utility {utility.name!r} fails on {given}: {type(error).__name__}: {message}") from error
        # NumPy gives a scalar, not an array, for a single return.
        number = np.asarray(values).dtype.kind in "fiu" if library == "numpy" else isinstance(values, type(returns))
        if not number:
            raise ValueError(f"utility {utility.name!r} gives {values!r} for {given}, not numbers of {library}")
        given_shape = tuple(np.shape(values)) if library == "numpy" else tuple(values.shape)
        if given_shape != shape[:-1]:
            raise ValueError(f"utility {utility.name!r} gives shape {given_shape} for {given}, not {shape[:-1]}")


class _Named:
    """A user's function and its further arguments; a copy or another process imports it again, by its path."""

    def __init__(self, path: str, arguments: dict[str, Any]):
        self._path, self._arguments = path, arguments
        self._function: Callable[..., Any] = import_named("utility", path)
        if not callable(self._function):
            raise ValueError(f"utility {path!r} is not callable")

    def __call__(self, returns: Any) -> Any:
        return self._function(returns, **self._arguments)

    def __reduce__(self) -> tuple[type[_Named], tuple[str, dict[str, Any]]]:
        return _Named, (self._path, self._arguments)
