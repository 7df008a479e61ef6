"""ESR and SER on a problem where their optima differ and the outcome comes long after the choice."""

from __future__ import annotations

from statistics import median
from typing import Any

import pytest

from algorithms import MOA2C, MOPPO
from tests.helpers.safe_or_risky import probability_of_risky

pytestmark = pytest.mark.slow

SEEDS = pytest.mark.parametrize("seed", [0, 1])
CHEAP_PPO: dict[str, Any] = {"epochs": 2, "minibatches": 2}


@SEEDS
@pytest.mark.parametrize(("delay", "total"), [(0, 20_000), (20, 50_000), (80, 100_000)])
def test_expected_utility_learns_the_optimum_of_esr_in_short_rollouts(delay: int, total: int, seed: int) -> None:
    settings: dict[str, Any] = {"advantage": "expected_utility", "utility_scale": 1.0, "gae_lambda": 0.95}
    assert probability_of_risky(MOPPO, delay, seed, total, **CHEAP_PPO, **settings) < 0.1


@pytest.mark.parametrize(("delay", "total"), [(0, 40_000), (20, 100_000), (80, 200_000)])
def test_expected_utility_of_mo_a2c_learns_the_optimum_of_esr_with_most_seeds(delay: int, total: int) -> None:
    settings: dict[str, Any] = {"advantage": "expected_utility", "utility_scale": 1.0, "gae_lambda": 0.95, "steps": 8}
    assert median(probability_of_risky(MOA2C, delay, seed, total, **settings) for seed in range(5)) < 0.2


def test_expected_utility_learns_the_optimum_of_esr_with_increases_that_are_discounted() -> None:
    settings: dict[str, Any] = {"advantage": "expected_utility", "utility_scale": 1.0, "accrued_discount": 1.0}
    assert probability_of_risky(MOPPO, 80, 0, 100_000, gamma=0.99, **CHEAP_PPO, **settings) < 0.1


@pytest.mark.parametrize(("delay", "total"), [(0, 10_000), (20, 50_000), (80, 100_000)])
def test_utility_differences_learn_the_optimum_of_esr_with_whole_episodes_and_lambda_1(delay: int, total: int) -> None:
    # With the step that resets, a rollout is an episode.
    settings: dict[str, Any] = {"gae_lambda": 1.0, "steps": delay + 2, "num_envs": 32}
    assert probability_of_risky(MOPPO, delay, 0, total, **settings) < 0.1


@SEEDS
@pytest.mark.parametrize(("delay", "total"), [(20, 400_000), (40, 400_000), (80, 800_000)])
def test_utility_differences_learn_the_optimum_of_ser_in_short_rollouts(delay: int, total: int, seed: int) -> None:
    settings: dict[str, Any] = {"gae_lambda": 0.95, "steps": 8}
    assert probability_of_risky(MOA2C, delay, seed, total, num_envs=256, **settings) > 0.8
    assert probability_of_risky(MOPPO, delay, seed, total // 4, **CHEAP_PPO, **settings) > 0.8


@SEEDS
@pytest.mark.parametrize(("delay", "total"), [(0, 20_000), (20, 50_000), (80, 100_000)])
def test_the_utility_gradient_learns_the_optimum_of_ser(delay: int, total: int, seed: int) -> None:
    settings: dict[str, Any] = {"advantage": "utility_gradient", "gae_lambda": 0.95}
    assert probability_of_risky(MOPPO, delay, seed, total, **CHEAP_PPO, **settings) > 0.9
