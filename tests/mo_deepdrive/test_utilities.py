"""Utilities against the paper's formulas (appendix D) in plain Python, and standard ones against their definitions."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mo_deepdrive.utilities import Utility, check_utility, make_utility

COSTS = {"g_force", "collision", "jerk", "lane_violation", "time", "near_miss", "right_of_way", "energy"}
ONE_WAYPOINT = ("distance", "destination", "g_force", "jerk")
STATIC_OBSTACLE = ("distance", "destination", "g_force", "collision", "jerk")
INTERSECTION = ("distance", "destination", "g_force", "collision", "jerk", "lane_violation")
LEFT_TURN = (*INTERSECTION, "time")


# The paper, on magnitudes: d distance, r destination, g g-force, c collision, j jerk, l lane violation.


def one_waypoint_linear(d: float, r: float, g: float, j: float) -> float:
    return 0.50 * d + 1 * r - 0.03 * g - 3.3e-5 * j


def one_waypoint_nonlinear(d: float, r: float, g: float, j: float) -> float:
    if d > 2:
        return 0.50 * d + 1 * d * r - 0.1 * g - 0.1 * j
    return 0.50 * d + 1 * r - (0.1 * g) ** 2 - (0.1 * j) ** 2


def static_obstacle_linear(d: float, r: float, g: float, c: float, j: float) -> float:
    return 0.30 * d + 1 * r - 1 * c - 0.03 * g - 3.3e-5 * j


def static_obstacle_nonlinear(d: float, r: float, g: float, c: float, j: float) -> float:
    if d == 0:
        return -10.0
    if d < 0:
        return 0.50 * d + 1 * r - 4 * c - (0.03 * g) ** 4 - (3.3e-5 * j) ** 4
    return 0.50 * d + 1 * r - 4 * c - 2 * (0.03 * g) ** 2


def intersection_linear(d: float, r: float, g: float, c: float, j: float, lane: float) -> float:
    return 0.50 * d + 10 * r - 4 * c - 0.03 * g - 0.0006 * j - 0.06 * lane


def intersection_nonlinear(d: float, r: float, g: float, c: float, j: float, lane: float) -> float:
    if d == 0:
        return -10.0
    if d < 0:
        return 0.50 * d + 1 * r - 4 * c - (0.03 * g) ** 4 - (3.3e-5 * j) ** 4 - 0.06 * lane
    return 0.50 * d + 1 * r - 4 * c - 2 * (0.03 * g) ** 2 - 0.06 * lane


PAPER: dict[str, tuple[tuple[str, ...], Callable[..., float]]] = {
    "one_waypoint_linear": (ONE_WAYPOINT, one_waypoint_linear),
    "one_waypoint_nonlinear": (ONE_WAYPOINT, one_waypoint_nonlinear),
    "static_obstacle_linear": (STATIC_OBSTACLE, static_obstacle_linear),
    "static_obstacle_nonlinear": (STATIC_OBSTACLE, static_obstacle_nonlinear),
    "intersection_linear": (INTERSECTION, intersection_linear),
    "intersection_nonlinear": (INTERSECTION, intersection_nonlinear),
}


def left_turn_linear(d: float, r: float, g: float, c: float, j: float, lane: float, t: float) -> float:
    return 0.50 * d + 10 * r - 10 * c - 0.03 * g - 0.0006 * j - 0.06 * lane - 0.1 * t


def left_turn_risk_averse(d: float, r: float, g: float, c: float, j: float, lane: float, t: float) -> float:
    return 10.0 * (1.0 - math.exp(-left_turn_linear(d, r, g, c, j, lane, t) / 10.0))


def one_waypoint_comfort_budget(d: float, r: float, g: float, j: float) -> float:
    return 0.1 * d + 10 * r - 2 * max(0.0, g - 5.0) - 0.05 * max(0.0, j - 40.0)


def static_obstacle_comfort_budget(d: float, r: float, g: float, c: float, j: float) -> float:
    return 0.1 * d + 10 * r - 10 * c - 2 * max(0.0, g - 7.0) - 0.05 * max(0.0, j - 110.0)


def left_turn_comfort_budget(d: float, r: float, g: float, c: float, j: float, lane: float, t: float) -> float:
    price = 10 * c + 0.06 * lane + 0.1 * t
    return 0.1 * d + 10 * r - price - 2 * max(0.0, g - 13.0) - 0.05 * max(0.0, j - 185.0)


def static_obstacle_tight_budget(d: float, r: float, g: float, c: float, j: float, t: float) -> float:
    return 0.1 * d + 10 * r - 10 * c - 0.2 * t - 5 * max(0.0, g - 5.0) - 0.2 * max(0.0, j - 60.0)


def intersection_hurried(d: float, r: float, g: float, c: float, j: float, lane: float, t: float) -> float:
    return intersection_linear(d, r, g, c, j, lane) - t


def left_turn_hurried_risk_averse(d: float, r: float, g: float, c: float, j: float, lane: float, t: float) -> float:
    value = 0.3 * d + 10 * r - 10 * c - 0.03 * g - 0.0006 * j - 0.06 * lane - t
    return 20.0 * (1.0 - math.exp(-value / 20.0))


def one_waypoint_satisficing(r: float, g: float, j: float, t: float) -> float:
    beyond = 2 * max(0.0, g - 4.0) + max(0.0, j - 30.0) / 5 + max(0.0, t - 12.0)
    return r * (2 + 8 * (1 - min(1.0, beyond)))


def one_waypoint_deadline(d: float, r: float, e: float, t: float) -> float:
    return 0.1 * d + (10 * r if t <= 40 else 0.0) - e


ROUNDABOUT = (*LEFT_TURN, "near_miss", "right_of_way", "energy")


def roundabout_linear(d: float, r: float, *costs: float) -> float:
    # Limits of 4.05 m/s^2 and 8.37 m/s^3 cost 0.02 a decision, and forcing others to brake on the first 2 a second.
    prices = (0.02 * 9.807 / 4.05, 10.0, 0.02 / 8.37, 0.06, 0.1, 0.5, 2.0 / 4.05, 0.01)
    return 0.1 * d + 10 * r - sum(price * cost for price, cost in zip(prices, costs, strict=True))


# Those of this package.
OWN: dict[str, tuple[tuple[str, ...], Callable[..., float]]] = {
    "left_turn_linear": (LEFT_TURN, left_turn_linear),
    "left_turn_risk_averse": (LEFT_TURN, left_turn_risk_averse),
    "one_waypoint_comfort_budget": (ONE_WAYPOINT, one_waypoint_comfort_budget),
    "static_obstacle_comfort_budget": (STATIC_OBSTACLE, static_obstacle_comfort_budget),
    "left_turn_comfort_budget": (LEFT_TURN, left_turn_comfort_budget),
    "static_obstacle_tight_budget": ((*STATIC_OBSTACLE, "time"), static_obstacle_tight_budget),
    "intersection_hurried": (LEFT_TURN, intersection_hurried),
    "left_turn_hurried_risk_averse": (LEFT_TURN, left_turn_hurried_risk_averse),
    "one_waypoint_satisficing": (("destination", "g_force", "jerk", "time"), one_waypoint_satisficing),
    "one_waypoint_deadline": (("distance", "destination", "energy", "time"), one_waypoint_deadline),
    "roundabout_linear": (ROUNDABOUT, roundabout_linear),
}
NAMED = {**PAPER, **OWN}

RANGES = {
    "distance": st.one_of(st.sampled_from([-2.0, 0.0, 2.0]), st.floats(-20.0, 100.0, width=32)),
    "destination": st.sampled_from([0.0, 1.0, 0.25]),
    "g_force": st.floats(0.0, 50.0, width=32),
    "collision": st.sampled_from([0.0, 1.0, 0.125]),
    "jerk": st.floats(0.0, 5000.0, width=32),
    "lane_violation": st.floats(0.0, 50.0, width=32),
    "time": st.floats(0.0, 60.0, width=32),
    "near_miss": st.floats(0.0, 60.0, width=32),
    "right_of_way": st.floats(0.0, 60.0, width=32),
    "energy": st.floats(0.0, 500.0, width=32),
}


def oriented(magnitudes: dict[str, float], objectives: tuple[str, ...], cost_sign: str) -> np.ndarray:
    """The return (d,) that an environment gives for these magnitudes."""
    flip = cost_sign == "maximise"
    return np.array([-magnitudes[name] if flip and name in COSTS else magnitudes[name] for name in objectives])


@st.composite
def situations(draw: st.DrawFn, name: str) -> tuple[dict[str, float], tuple[str, ...], str]:
    """Magnitudes, an order of the objectives and a sign of the costs."""
    objectives = NAMED[name][0]
    magnitudes = {objective: draw(RANGES[objective]) for objective in objectives}
    return magnitudes, tuple(draw(st.permutations(objectives))), draw(st.sampled_from(["maximise", "paper"]))


def literal(name: str, magnitudes: dict[str, float]) -> float:
    objectives, formula = NAMED[name]
    return formula(*(magnitudes[objective] for objective in objectives))


@pytest.mark.parametrize("name", NAMED)
@given(data=st.data())
def test_a_named_utility_equals_its_literal_formula_in_any_order_and_sign(name: str, data: st.DataObject) -> None:
    magnitudes, order, cost_sign = data.draw(situations(name))
    expected = literal(name, magnitudes)
    utility = make_utility(name, order, cost_sign=cost_sign)
    returns = oriented(magnitudes, order, cost_sign)
    size = 1.0 + abs(expected) + sum(abs(m) for m in magnitudes.values())
    for kind, epsilon in ((np.float64, 1e-14), (np.float32, 1e-6)):
        array = returns.astype(kind)
        by_numpy, by_torch = utility(array), utility(torch.from_numpy(array))
        assert np.asarray(by_numpy).dtype == kind
        assert by_torch.dtype == torch.from_numpy(array).dtype
        assert float(by_numpy) == pytest.approx(expected, abs=10 * epsilon * size)
        assert float(by_torch) == pytest.approx(expected, abs=10 * epsilon * size)


def every_utility() -> list[Utility]:
    """One of each utility, with three objectives if they can be chosen."""
    names = ("a", "b", "c")
    return [
        *(make_utility(name, NAMED[name][0]) for name in NAMED),
        make_utility("linear", names, weights=[0.5, 0.25, 0.25]),
        make_utility("augmented_chebyshev", names, weights=[0.5, 0.25, 0.25], ideal=[1.0, 2.0, 3.0]),
        make_utility("generalised_gini", names, weights=[0.5, 0.3, 0.2], scales=[1.0, 2.0, 4.0]),
    ]


ALL = pytest.mark.parametrize("utility", every_utility(), ids=lambda utility: utility.name)


@ALL
@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 3), (2, 1, 4), (0,), (2, 0)])
def test_batches_of_any_leading_shape_are_evaluated_row_by_row(utility: Utility, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    returns = rng.normal(0.0, 3.0, (*shape, len(utility.objectives)))
    returns[..., 0] = np.where(rng.random(shape) < 0.2, 0.0, returns[..., 0])
    by_numpy, by_torch = utility(returns), utility(torch.tensor(returns))
    assert np.shape(by_numpy) == shape
    assert by_torch.shape == shape
    rows = returns.reshape(-1, len(utility.objectives))
    expected = np.array([float(utility(row)) for row in rows]).reshape(shape)
    np.testing.assert_allclose(by_numpy, expected, rtol=1e-12)
    np.testing.assert_allclose(by_torch.numpy(), expected, rtol=1e-12)


@ALL
def test_gradients_are_those_of_finite_differences(utility: Utility) -> None:
    points = np.random.default_rng(0).normal(0.0, 3.0, (8, len(utility.objectives)))
    assert torch.autograd.gradcheck(utility, torch.tensor(points, requires_grad=True), atol=1e-4)


@pytest.mark.parametrize("name", [name for name in NAMED if name.endswith("_linear")])
@pytest.mark.parametrize("cost_sign", ["maximise", "paper"])
@given(data=st.data())
def test_the_weights_of_a_named_linear_utility_are_its_factors_of_returns(
    name: str, cost_sign: str, data: st.DataObject
) -> None:
    magnitudes, order, _ = data.draw(situations(name))
    utility = make_utility(name, order, cost_sign=cost_sign)
    assert utility.weights is not None
    assert len(utility.weights) == len(order)
    returns = oriented(magnitudes, order, cost_sign)
    assert float(np.dot(utility.weights, returns)) == pytest.approx(literal(name, magnitudes), abs=1e-9)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("zeros", [np.zeros, torch.zeros])
def test_a_utility_that_is_no_number_at_the_first_decision_is_refused(zeros: Any) -> None:
    ratio = Utility("ratio", ("a", "b"), lambda returns: returns[..., 0] / returns[..., 1])
    with pytest.raises(ValueError, match=r"utility .ratio. = nan for the return"):
        check_utility(ratio, zeros)


def test_a_weight_that_rewards_a_cost_is_warned_of() -> None:
    weights = {"distance": -1.0, "jerk": -0.1}
    with pytest.warns(UserWarning, match=r"weight of 'jerk' = -0.1 rewards a cost") as caught:
        make_utility("linear", ONE_WAYPOINT, weights=weights)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_utility("linear", ONE_WAYPOINT, "paper", weights=weights)


@given(
    returns=st.lists(st.floats(-100.0, 100.0), min_size=3, max_size=3),
    i=st.integers(0, 2),
    gain=st.floats(0.01, 10.0),
    rho=st.floats(0.001, 1.0),
)
def test_augmented_chebyshev_equals_its_definition_and_increases_in_every_objective(
    returns: list[float], i: int, gain: float, rho: float
) -> None:
    weights, ideal = [0.2, 0.3, 0.5], [100.0, 50.0, 0.0]
    utility = make_utility("augmented_chebyshev", ("a", "b", "c"), weights=weights, ideal=ideal, rho=rho)
    gaps = [w * (z - x) for w, z, x in zip(weights, ideal, returns, strict=True)]
    value = float(utility(np.array(returns)))
    assert value == pytest.approx(-(max(gaps) + rho * sum(gaps)), abs=1e-9)
    assert float(utility(torch.tensor(returns, dtype=torch.float64))) == pytest.approx(value, abs=1e-9)
    better = list(returns)
    better[i] += gain
    assert float(utility(np.array(better))) > value


GINI = [0.5, 0.3, 0.15, 0.05]


VECTORS = st.lists(st.floats(-100.0, 100.0), min_size=4, max_size=4)


@given(returns=VECTORS)
def test_generalised_gini_weights_the_worst_objective_most(returns: list[float]) -> None:
    expected = sum(w * x for w, x in zip(GINI, sorted(returns), strict=True))
    utility = make_utility("generalised_gini", "abcd", weights=GINI)
    assert float(utility(np.array(returns))) == pytest.approx(expected, abs=1e-9)
    scaled = make_utility("generalised_gini", "abcd", weights=GINI, scales=[10.0, 1.0, 1.0, 2.0])
    assert float(scaled(np.array(returns) * [10.0, 1.0, 1.0, 2.0])) == pytest.approx(expected, abs=1e-9)
    assert float(utility(torch.tensor(returns, dtype=torch.float64))) == pytest.approx(expected, abs=1e-9)


OWN = """
import torch

def product(returns):
    return returns[..., 0] * returns[..., 1]

def power(returns, exponent=1.0, *, shift=0.0):
    return (returns[..., 0] + shift) ** exponent

class Smallest:
    def __call__(self, returns):
        return returns.min(-1)

smallest = Smallest()
number = 3
"""


@pytest.fixture
def own_module(tmp_path, monkeypatch) -> str:
    """A package with custom utilities, importable in one test; its name."""
    package = tmp_path / "users_package_of_utilities"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "mine.py").write_text(OWN)
    (package / "broken.py").write_text("import a_module_that_nobody_has")
    monkeypatch.syspath_prepend(str(tmp_path))
    return "users_package_of_utilities.mine"


def test_a_custom_function_is_given_by_its_path(own_module: str) -> None:
    utility = make_utility(f"{own_module}:product", ("a", "b"))
    assert utility.name == f"{own_module}:product"
    assert utility.objectives == ("a", "b")
    assert utility.weights is None
    returns = np.array([[2.0, 3.0], [-1.0, 4.0]])
    np.testing.assert_array_equal(utility(returns), [6.0, -4.0])
    point = torch.tensor([2.0, 3.0], requires_grad=True)
    (gradient,) = torch.autograd.grad(utility(point), point)
    assert gradient.tolist() == [3.0, 2.0]
    utility = make_utility(f"{own_module}:power", ("a",), exponent=2.0, shift=1.0)
    assert float(utility(np.array([2.0]))) == 9.0
    assert float(make_utility(f"{own_module}:power", ("a",))(np.array([2.0]))) == 2.0


@pytest.mark.parametrize("name", NAMED)
def test_a_missing_objective_is_refused(name: str) -> None:
    objectives = NAMED[name][0]
    with pytest.raises(ValueError, match=rf"needs {objectives[0]}; the environment has"):
        make_utility(name, objectives[1:])


@pytest.mark.parametrize("cost_sign", ["maximise", "paper"])
@pytest.mark.parametrize("name", NAMED)
def test_further_objectives_weigh_nothing(name: str, cost_sign: str) -> None:
    objectives = NAMED[name][0]
    more = ("comfort", *objectives, "calm")
    returns = np.random.default_rng(0).normal(size=(5, len(more)))
    expected = make_utility(name, objectives, cost_sign)(returns[:, 1:-1])
    utility = make_utility(name, more, cost_sign)
    np.testing.assert_allclose(utility(returns), expected, rtol=1e-12)
    assert utility.weights is None or (utility.weights[0], utility.weights[-1]) == (0.0, 0.0)


def test_a_comfort_budget_takes_other_budgets() -> None:
    name = "left_turn_comfort_budget"
    returns = np.array([[30.0, 1.0, -14.0, 0.0, -195.0, -5.0, -20.0]])
    objectives = NAMED[name][0]
    values = [
        make_utility(name, objectives, **budgets)(returns)[0]
        for budgets in (
            {},
            {"g_force": 13, "jerk": 185},
            {"g_force": 14.0},
            {"jerk": 195.0},
            {"g_force": 0.0, "jerk": 0},
        )
    ]
    np.testing.assert_allclose(values, [8.2, 8.2, 10.2, 8.7, 8.2 + 2 * 1 + 0.05 * 10 - 2 * 14 - 0.05 * 195])


# ----------------------------------------------------------------------------------------------------------- refusals

CHEBYSHEV = {"weights": [0.5, 0.5], "ideal": [0.0, 0.0]}
VECTORS_OF_NUMBERS = (
    ("linear", "weights", {}),
    ("augmented_chebyshev", "weights", {"ideal": [0.0, 0.0]}),
    ("augmented_chebyshev", "ideal", {"weights": [0.5, 0.5]}),
    ("generalised_gini", "weights", {}),
    ("generalised_gini", "scales", {"weights": [0.5, 0.5]}),
)
NOT_TWO_NUMBERS = ([], [1.0, 0.5, 0.1], [1.0, math.nan], [True, 1], ["1", "2"], 3.0)
REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("zzz", {}, "is unknown; known: "),
    ("one_waypoint_liner", {}, "'one_waypoint_liner' is unknown; did you mean 'one_waypoint_linear'"),
    ("Linear", {}, "'Linear' is unknown; did you mean 'linear'"),
    ("one_waypoint_linear", {"cost_sign": "Paper"}, "cost_sign"),
    *((name, {"weights": [1.0]}, "takes no arguments") for name in NAMED),
    *(
        ("one_waypoint_comfort_budget", {"jerk": wrong}, "must be finite and at least 0")
        for wrong in (-1.0, math.nan, "5")
    ),
    *((name, {**rest, which: wrong}, which) for name, which, rest in VECTORS_OF_NUMBERS for wrong in NOT_TWO_NUMBERS),
    *((name, {"weight": [0.5, 0.5]}, "weight") for name in ("linear", "augmented_chebyshev", "generalised_gini")),
    *(("augmented_chebyshev", {**CHEBYSHEV, "rho": wrong}, "rho") for wrong in (-0.1, math.nan, "0.05", None, True)),
    ("generalised_gini", {"weights": [0.4, 0.6]}, "must be non-increasing"),
    ("generalised_gini", {"weights": [0.5, -0.1]}, "must be non-increasing"),
    ("generalised_gini", {"weights": [0.5, 0.5], "scales": [1.0, 0.0]}, "scales"),
    ("linear", {"weights": {"time": 1, "enrgy": 2}}, "weights of utility 'linear' has 'enrgy'; did you mean 'energy'?"),
    ("linear", {"weights": {"time": "much"}}, "weights = ['much', 0.0] must be 2 finite numbers"),
    ("augmented_chebyshev", {"weights": {"time": 1}, "ideal": {"time": 1}}, "has no number for energy"),
    ("users_package_of_utilities.mine:absent", {}, "absent"),
    ("users_package_of_utilities.broken:product", {}, "a_module_that_nobody_has"),
    ("a_package_that_nobody_has:product", {}, "a_package_that_nobody_has"),
    ("users_package_of_utilities.mine:number", {}, "not callable"),
]


@pytest.mark.parametrize(("name", "arguments", "message"), REFUSED)
def test_what_is_no_utility_is_refused_by_name(
    own_module: str, name: str, arguments: dict[str, Any], message: str
) -> None:
    objectives = NAMED[name][0] if name in NAMED else ("time", "energy")
    with pytest.raises(ValueError, match=re.escape(message)):
        make_utility(name, objectives, **arguments)


@ALL
@pytest.mark.parametrize("off", [-1, 1])
def test_returns_of_another_length_are_refused(utility: Utility, off: int) -> None:
    d = len(utility.objectives)
    for returns in (np.zeros(d + off), np.zeros((2, d + off)), torch.zeros(3, d + off), np.zeros((d, d + off))):
        with pytest.raises(ValueError, match=f"takes {d} objectives.*have {d + off}"):
            utility(returns)


# ------------------------------------------------------------------------------------------------- numbers by name

RETURNS = np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 4.0]])


@pytest.mark.parametrize(
    ("name", "by_name", "in_order"),
    [
        ("linear", {"weights": {"c": 2, "a": 0.5}}, {"weights": [0.5, 0.0, 2.0]}),
        (
            "augmented_chebyshev",
            {"weights": {"b": 1}, "ideal": {"c": 5, "b": 3, "a": 0}},
            {"weights": [0.0, 1.0, 0.0], "ideal": [0.0, 3.0, 5.0]},
        ),
        ("generalised_gini", {"weights": [3, 2, 1], "scales": {"b": 4}}, {"weights": [3, 2, 1], "scales": [1, 4, 1]}),
    ],
)
def test_numbers_are_given_by_the_names_of_objectives(
    name: str, by_name: dict[str, Any], in_order: dict[str, Any]
) -> None:
    first, second = (make_utility(name, ("a", "b", "c"), **each) for each in (by_name, in_order))
    np.testing.assert_array_equal(first(RETURNS), second(RETURNS))
    assert first.weights == second.weights
