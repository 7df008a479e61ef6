"""Return and advantage estimators against plain loops over single episodes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from algorithms.common.advantages import generalised_advantages, utility_differences, utility_gradient
from mo_deepdrive.utilities import Utility, make_utility

NAMES = ("a", "b", "c")
WEIGHTS = [0.7, -1.3, 0.2]
LINEAR = make_utility("linear", NAMES, weights=WEIGHTS)


def crooked(returns):
    """Neither linear nor additive; for plain numbers, arrays and tensors."""
    return returns[..., 0] * returns[..., 1] - 0.1 * returns[..., 2] ** 2 + returns[..., 0]


CROOKED = Utility("crooked", NAMES, crooked)


@st.composite
def collections(draw: st.DrawFn) -> dict[str, torch.Tensor]:
    """Random rewards, values and ends of episodes, shaped (T, N, ...), as a collection loop would hand them over.

    ``accrued`` and ``discount`` run on within an episode and start anew after its end; the first row may be in the
    middle of an episode.
    """
    steps, worlds = draw(st.integers(1, 12)), draw(st.integers(1, 3))
    gamma = draw(st.sampled_from([0.0, 0.5, 0.9, 0.99, 1.0]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    p_end = draw(st.sampled_from([0.0, 0.2, 0.5, 1.0]))
    terminated = rng.random((steps, worlds)) < p_end / 2
    truncated = rng.random((steps, worlds)) < p_end / 2
    rewards = rng.normal(size=(steps, worlds, 3))
    values = rng.normal(size=(steps, worlds, 3))
    bootstrap = rng.normal(size=(steps, worlds, 3))
    accrued, discount = np.zeros((steps, worlds, 3)), np.ones((steps, worlds))
    next_values = np.zeros((steps, worlds, 3))
    for n in range(worlds):
        age = int(rng.integers(0, 5))
        total = rng.normal(size=3) * (age > 0)
        for t in range(steps):
            accrued[t, n], discount[t, n] = total, gamma**age
            over = terminated[t, n] or truncated[t, n]
            if terminated[t, n]:
                next_values[t, n] = 0.0
            elif over or t == steps - 1:
                next_values[t, n] = bootstrap[t, n]
            else:
                next_values[t, n] = values[t + 1, n]
            total, age = total + gamma**age * rewards[t, n], age + 1
            if over:
                total, age = np.zeros(3), 0
    tensors = {
        "rewards": rewards,
        "values": values,
        "next_values": next_values,
        "accrued": accrued,
        "discount": discount,
        "going_on": ~(terminated | truncated),
        "gamma": np.array(gamma),
    }
    return {name: torch.tensor(array, dtype=torch.float64) for name, array in tensors.items()}


def differences(c: dict[str, torch.Tensor], utility: Utility, as_printed: bool) -> torch.Tensor:
    arguments = (c["accrued"], c["rewards"], c["discount"], c["values"], c["next_values"], float(c["gamma"]))
    return utility_differences(utility, *arguments, as_printed=as_printed)


@given(c=collections(), decay=st.floats(0.0, 1.0))
def test_generalised_advantages_adds_up_to_the_end_of_the_episode_like_a_double_loop(
    c: dict[str, torch.Tensor], decay: float
) -> None:
    deltas, going_on = c["rewards"][..., 0], c["going_on"]
    expected = torch.zeros_like(deltas)
    for n in range(deltas.shape[1]):
        for t in range(len(deltas)):
            factor = 1.0
            for k in range(t, len(deltas)):
                expected[t, n] += factor * deltas[k, n]
                factor *= decay
                if not going_on[k, n]:
                    break
    torch.testing.assert_close(generalised_advantages(deltas, going_on, decay), expected)


@given(c=collections(), decay=st.floats(0.0, 1.0))
def test_generalised_advantages_of_vectors_is_that_of_every_component(c: dict[str, torch.Tensor], decay: float) -> None:
    together = generalised_advantages(c["rewards"], c["going_on"].unsqueeze(-1), decay)
    apart = [generalised_advantages(c["rewards"][..., i], c["going_on"], decay) for i in range(3)]
    torch.testing.assert_close(together, torch.stack(apart, dim=-1))


def test_generalised_advantages_does_not_modify_its_arguments_and_keeps_their_precision() -> None:
    for dtype in (torch.float32, torch.float64):
        deltas, going_on = torch.ones(4, 2, dtype=dtype), torch.ones(4, 1, dtype=dtype)
        sums = generalised_advantages(deltas, going_on, 0.5)
        assert sums.dtype == dtype
        assert sums[:, 0].tolist() == [1.875, 1.75, 1.5, 1.0]
        assert (deltas == 1).all()
        assert (going_on == 1).all()


@given(c=collections())
def test_with_lambda_one_the_advantage_is_the_monte_carlo_return_minus_the_value(c: dict[str, torch.Tensor]) -> None:
    gamma = float(c["gamma"])
    deltas = c["rewards"] + gamma * c["next_values"] - c["values"]
    advantages = generalised_advantages(deltas, c["going_on"].unsqueeze(-1), gamma)
    steps, worlds, _ = deltas.shape
    for n in range(worlds):
        for t in range(steps):
            outcome, k = torch.zeros(3, dtype=torch.float64), t
            while True:
                outcome = outcome + gamma ** (k - t) * c["rewards"][k, n]
                if k == steps - 1 or not c["going_on"][k, n]:
                    # Zero after termination: then this is the return of the episode and nothing else.
                    outcome = outcome + gamma ** (k - t + 1) * c["next_values"][k, n]
                    break
                k += 1
            torch.testing.assert_close(advantages[t, n], outcome - c["values"][t, n])


@given(c=collections())
def test_utility_differences_equal_the_equation_row_by_row(c: dict[str, torch.Tensor]) -> None:
    found = {as_printed: differences(c, CROOKED, as_printed) for as_printed in (False, True)}
    steps, worlds, _ = c["rewards"].shape
    gamma = float(c["gamma"])
    for t in range(steps):
        for n in range(worlds):
            factor = float(c["discount"][t, n])
            after = c["accrued"][t, n] + factor * c["rewards"][t, n]  # R_{t+1}
            before = crooked(c["accrued"][t, n] + factor * c["values"][t, n])
            consistent = crooked(after + factor * gamma * c["next_values"][t, n]) - before
            printed = crooked(after + c["next_values"][t, n]) - before
            torch.testing.assert_close(found[False][t, n], consistent)
            torch.testing.assert_close(found[True][t, n], printed)


@given(c=collections())
def test_under_a_linear_utility_the_difference_is_the_discounted_scalar_temporal_difference(
    c: dict[str, torch.Tensor],
) -> None:
    weights = torch.tensor(WEIGHTS, dtype=torch.float64)
    deltas = c["rewards"] + float(c["gamma"]) * c["next_values"] - c["values"]
    torch.testing.assert_close(differences(c, LINEAR, as_printed=False), c["discount"] * (deltas @ weights))


@given(c=collections())
def test_as_printed_differs_by_the_undiscounted_next_value_alone(c: dict[str, torch.Tensor]) -> None:
    weights = torch.tensor(WEIGHTS, dtype=torch.float64)
    gap = differences(c, LINEAR, as_printed=True) - differences(c, LINEAR, as_printed=False)
    following = c["discount"] * float(c["gamma"])  # gamma^{t+1}
    torch.testing.assert_close(gap, (1.0 - following) * (c["next_values"] @ weights))


def test_as_printed_equals_the_consistent_form_without_discounting_and_at_the_end() -> None:
    rng = np.random.default_rng(0)
    accrued, rewards, values, next_values = (torch.tensor(rng.normal(size=(5, 3))) for _ in range(4))
    ones = torch.ones(5, dtype=torch.float64)
    undiscounted = [
        utility_differences(CROOKED, accrued, rewards, ones, values, next_values, 1.0, as_printed=form)
        for form in (False, True)
    ]
    torch.testing.assert_close(*undiscounted)
    terminal = [
        utility_differences(CROOKED, accrued, rewards, 0.7 * ones, values, 0.0 * values, 0.9, as_printed=form)
        for form in (False, True)
    ]
    torch.testing.assert_close(*terminal)


@given(c=collections())
def test_with_lambda_one_the_differences_telescope_to_the_utility_of_the_whole_return(
    c: dict[str, torch.Tensor],
) -> None:
    advantages = generalised_advantages(differences(c, CROOKED, as_printed=False), c["going_on"], 1.0)
    steps, worlds, _ = c["rewards"].shape
    gamma = float(c["gamma"])
    for n in range(worlds):
        for t in range(steps):
            last = next((k for k in range(t, steps) if not c["going_on"][k, n]), steps - 1)
            final = c["accrued"][last, n] + c["discount"][last, n] * (
                c["rewards"][last, n] + gamma * c["next_values"][last, n]
            )
            now = c["accrued"][t, n] + c["discount"][t, n] * c["values"][t, n]
            torch.testing.assert_close(advantages[t, n], crooked(final) - crooked(now))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_gradient_of_a_linear_utility_is_its_weights_everywhere(dtype: torch.dtype) -> None:
    for point in ([0.0, 0.0, 0.0], [3.0, -100.0, 0.5]):
        gradient = utility_gradient(LINEAR, torch.tensor(point, dtype=dtype))
        torch.testing.assert_close(gradient, torch.tensor(WEIGHTS, dtype=dtype))


@given(point=st.lists(st.floats(-10.0, 10.0), min_size=3, max_size=3))
def test_the_gradient_of_a_nonlinear_utility_is_its_slope_at_the_expected_return(point: list[float]) -> None:
    a, b, c = point
    gradient = utility_gradient(CROOKED, torch.tensor(point, dtype=torch.float64))
    torch.testing.assert_close(gradient, torch.tensor([b + 1.0, a, -0.2 * c], dtype=torch.float64))


def test_taking_the_gradient_does_not_modify_the_expected_return() -> None:
    point = torch.tensor([1.0, 2.0, 3.0])
    gradient = utility_gradient(CROOKED, point)
    assert point.tolist() == [1.0, 2.0, 3.0]
    assert not point.requires_grad
    assert point.grad is None
    assert not gradient.requires_grad
