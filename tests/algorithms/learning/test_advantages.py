"""Advantages and the gradient of a utility against plain loops over the equations."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from algorithms.learning.advantages import generalised_advantages, normalise, utility_gradient
from mo_deepdrive.utilities import Utility

CROOKED = Utility(
    "crooked",
    ("a", "b", "c"),
    lambda returns: returns[..., 0] * returns[..., 1] - 0.1 * returns[..., 2] ** 2 + returns[..., 0],
)


@st.composite
def collections(draw: st.DrawFn) -> dict[str, torch.Tensor]:
    """Random rewards, weights and ends of episodes (T, N)."""
    shape = draw(st.integers(1, 12)), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    ended = rng.random(shape) < draw(st.sampled_from([0.0, 0.2, 0.5, 1.0]))
    arrays = {"rewards": rng.normal(size=shape), "weights": 1.0 + rng.random(shape), "ended": ended}
    return {name: torch.tensor(array) for name, array in arrays.items()}


@pytest.mark.slow
@given(c=collections(), decay=st.floats(0.0, 1.0))
def test_generalised_advantages_adds_up_to_the_end_of_the_episode_like_a_double_loop(
    c: dict[str, torch.Tensor], decay: float
) -> None:
    deltas, ended = c["rewards"], c["ended"]
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


@given(point=st.lists(st.floats(-10.0, 10.0), min_size=3, max_size=3))
def test_the_gradient_of_a_nonlinear_utility_is_its_slope_at_the_expected_return(point: list[float]) -> None:
    a, b, c = point
    gradient = utility_gradient(CROOKED, torch.tensor(point, dtype=torch.float64))
    torch.testing.assert_close(gradient, torch.tensor([b + 1.0, a, -0.2 * c], dtype=torch.float64))


@given(c=collections())
def test_normalised_advantages_have_mean_zero_and_deviation_one_under_the_weights(c: dict[str, torch.Tensor]) -> None:
    advantages, weights = c["rewards"], c["weights"] / c["weights"].sum()
    pairs = list(zip(advantages.flatten().tolist(), weights.flatten().tolist(), strict=True))
    mean = sum(weight * advantage for advantage, weight in pairs)
    variance = sum(weight * (advantage - mean) ** 2 for advantage, weight in pairs)
    torch.testing.assert_close(normalise(advantages, weights), (advantages - mean) / (variance**0.5 + 1e-8))
