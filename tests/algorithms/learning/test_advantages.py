"""Advantages and the gradient of a utility against plain loops over the equations."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from algorithms.learning.advantages import generalised_advantages, normalise, utility_gradient
from tests.helpers.advantage_data import CROOKED, collections


@pytest.mark.slow
@given(c=collections(), decay=st.floats(0.0, 1.0))
def test_generalised_advantages_adds_up_to_the_end_of_the_episode_like_a_double_loop(
    c: dict[str, torch.Tensor], decay: float
) -> None:
    deltas, ended = c["rewards"][..., 0], c["going_on"].logical_not()
    expected = torch.zeros_like(deltas)
    for n in range(deltas.shape[1]):
        for t in range(len(deltas)):
            factor = 1.0
            for k in range(t, len(deltas)):
                expected[t, n] += factor * deltas[k, n]
                factor *= decay
                if ended[k, n]:
                    break
    torch.testing.assert_close(generalised_advantages(deltas, ended, decay), expected)


@pytest.mark.slow
@given(c=collections(), decay=st.floats(0.0, 1.0))
def test_generalised_advantages_of_vectors_is_that_of_every_component(c: dict[str, torch.Tensor], decay: float) -> None:
    together = generalised_advantages(c["rewards"], c["going_on"].logical_not().unsqueeze(-1), decay)
    apart = [generalised_advantages(c["rewards"][..., i], c["going_on"].logical_not(), decay) for i in range(3)]
    torch.testing.assert_close(together, torch.stack(apart, dim=-1))


@given(c=collections())
def test_with_lambda_one_the_advantage_is_the_monte_carlo_return_minus_the_value(c: dict[str, torch.Tensor]) -> None:
    gamma = float(c["gamma"])
    deltas = c["rewards"] + gamma * c["next_values"] - c["values"]
    advantages = generalised_advantages(deltas, c["going_on"].logical_not().unsqueeze(-1), gamma)
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


@given(point=st.lists(st.floats(-10.0, 10.0), min_size=3, max_size=3))
def test_the_gradient_of_a_nonlinear_utility_is_its_slope_at_the_expected_return(point: list[float]) -> None:
    a, b, c = point
    gradient = utility_gradient(CROOKED, torch.tensor(point, dtype=torch.float64))
    torch.testing.assert_close(gradient, torch.tensor([b + 1.0, a, -0.2 * c], dtype=torch.float64))


@given(c=collections())
def test_normalised_advantages_have_mean_zero_and_deviation_one_under_the_weights(c: dict[str, torch.Tensor]) -> None:
    advantages, steps = c["rewards"][..., 0], 1.0 + c["values"][..., 0].abs()
    weights = steps / steps.sum()
    pairs = list(zip(advantages.flatten().tolist(), weights.flatten().tolist(), strict=True))
    mean = sum(weight * advantage for advantage, weight in pairs)
    variance = sum(weight * (advantage - mean) ** 2 for advantage, weight in pairs)
    torch.testing.assert_close(normalise(advantages, weights), (advantages - mean) / (variance**0.5 + 1e-8))
