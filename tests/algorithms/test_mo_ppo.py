"""MO-PPO: with one epoch of one minibatch its step is that of MO-A2C; its clipped steps are tested with PPO's."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from algorithms import MOA2C, MOPPO
from tests.helpers.agents import (
    CONTINUOUS,
    experienced,
    handmade,
    parameters_of,
    samples_of,
    step_of,
)

ADVANTAGES = pytest.mark.parametrize(
    "advantage", ["utility_difference", "as_printed", "utility_gradient", "expected_utility"]
)


@ADVANTAGES
@pytest.mark.parametrize("env", [{}, CONTINUOUS], ids=["discrete", "continuous"])
@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("accrued_discount", [None, 1.0])
def test_one_epoch_of_one_minibatch_is_the_step_of_mo_a2c(
    advantage: str, env: dict[str, Any], normalised: bool, accrued_discount: float | None
) -> None:
    settings = {
        "advantage": advantage,
        "env": env,
        "normalise_advantages": normalised,
        "accrued_discount": accrued_discount,
    }
    one, clipped = experienced(MOPPO, epochs=1, minibatches=1, **settings)
    other, plain = experienced(MOA2C, **settings)
    for agent in (one, other):
        assert step_of(agent, samples_of(agent, handmade(agent, masked=True)))["policy/entropy"] > 0.0
    for mine, theirs in zip(parameters_of(clipped), parameters_of(plain), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)
