"""Random rewards, values and ends of episodes, and utilities, for tests of advantages."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import strategies as st

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
