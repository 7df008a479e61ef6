"""Policies against probabilities written down and torch's own distributions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.stats
import torch
from torch import distributions, nn

from algorithms.learning.actors import (
    HIGHEST_LOG_STD,
    INITIAL_LOG_STD,
    LOG_STD_GAIN,
    LOWEST_LOG_STD,
    Actor,
    CategoricalActor,
    GaussianActor,
    StateGaussianActor,
)
from algorithms.learning.networks import mlp

# A test that samples with a fixed seed passes or fails for good; a correct sampler fails one seed in ten thousand.
SIGNIFICANCE = 1e-4


def categorical(inputs: int, hidden: list[int], actions: int, generator: torch.Generator) -> CategoricalActor:
    return CategoricalActor(mlp(inputs, hidden, actions, generator, output_gain=0.01))


def gaussian(inputs: int, hidden: list[int], actions: int, generator: torch.Generator) -> GaussianActor:
    return GaussianActor(mlp(inputs, hidden, actions, generator, output_gain=0.01), actions)


def state_gaussian(inputs: int, hidden: list[int], actions: int, generator: torch.Generator) -> StateGaussianActor:
    return StateGaussianActor(mlp(inputs, hidden, 2 * actions, generator, output_gain=0.01), actions)


ACTORS = pytest.mark.parametrize("kind", [categorical, gaussian, state_gaussian])
GAUSSIAN = pytest.mark.parametrize("kind", [gaussian, state_gaussian])


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def linear_layers(network: nn.Module) -> list[nn.Linear]:
    return [module for module in network.modules() if isinstance(module, nn.Linear)]


def with_outputs(actor: Actor, outputs: list[float]) -> Actor:
    """The actor, changed to give the same outputs for every input."""
    last = linear_layers(actor.body)[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(torch.tensor(outputs))
    return actor


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    "probabilities",
    [[0.5, 0.5], [0.1, 0.2, 0.3, 0.4], [0.97, 0.01, 0.01, 0.01], [1 / 22] * 22, [0.9] + [0.1 / 21] * 21],
)
def test_actions_are_drawn_as_often_as_their_probabilities_say(probabilities: list[float], seed: int) -> None:
    actor = categorical(3, [4], len(probabilities), seeded(0))
    with_outputs(actor, [math.log(p) + 5.0 for p in probabilities])
    draws = 50_000
    actions = actor.act(torch.zeros(draws, 3), seeded(seed))
    counts = np.bincount(actions.numpy(), minlength=len(probabilities))
    assert scipy.stats.chisquare(counts, draws * np.array(probabilities)).pvalue > SIGNIFICANCE


@GAUSSIAN
@pytest.mark.parametrize("seed", range(3))
def test_continuous_actions_are_drawn_from_the_normal_distribution(kind: Callable[..., Any], seed: int) -> None:
    actor = kind(3, [4], 2, seeded(0))
    if kind is gaussian:
        with_outputs(actor, [0.3, -2.0])
        with torch.no_grad():
            actor.log_std.copy_(torch.tensor([-0.5, 0.7]))
    else:
        with_outputs(actor, [0.3, -2.0, *((log_std - INITIAL_LOG_STD) / LOG_STD_GAIN for log_std in (-0.5, 0.7))])
    actions = actor.act(torch.zeros(20_000, 3), seeded(seed)).detach().numpy()
    for axis, (mean, log_std) in enumerate([(0.3, -0.5), (-2.0, 0.7)]):
        assert scipy.stats.kstest(actions[:, axis], "norm", (mean, math.exp(log_std))).pvalue > SIGNIFICANCE
    assert scipy.stats.pearsonr(actions[:, 0], actions[:, 1]).pvalue > SIGNIFICANCE


def randomised(kind: Callable[..., Any], inputs: int, actions: int) -> Actor:
    """An actor far from its initial, nearly uniform policy."""
    actor = kind(inputs, [16, 8], actions, seeded(1))
    with torch.no_grad():
        linear_layers(actor.body)[-1].weight.mul_(200.0)
        if type(actor) is GaussianActor:
            actor.log_std.copy_(torch.linspace(-2.0, 1.0, actions))
    return actor.double()


def normal_of(actor: GaussianActor, x: torch.Tensor) -> distributions.Distribution:
    """torch's own distribution of the actions."""
    outputs = actor.body(x)
    if type(actor) is GaussianActor:
        return distributions.Independent(distributions.Normal(outputs, actor.log_std.exp()), 1)
    means, log_std = outputs.chunk(2, dim=-1)
    deviations = (LOG_STD_GAIN * log_std + INITIAL_LOG_STD).clamp(LOWEST_LOG_STD, HIGHEST_LOG_STD).exp()
    return distributions.Independent(distributions.Normal(means, deviations), 1)


@pytest.mark.parametrize("shape", [(), (5,), (4, 3), (2, 1, 3)])
def test_categorical_log_probabilities_and_entropies_are_those_of_torch(shape: tuple[int, ...]) -> None:
    actor = randomised(categorical, 6, 22)
    x = torch.randn(*shape, 6, generator=seeded(2), dtype=torch.float64)
    reference = distributions.Categorical(logits=actor.body(x))
    actions = torch.randint(22, shape, generator=seeded(3))
    log_prob, entropy = actor(x, actions)
    torch.testing.assert_close(log_prob, reference.log_prob(actions))
    torch.testing.assert_close(entropy, reference.entropy())


@GAUSSIAN
@pytest.mark.parametrize("shape", [(), (5,), (4, 3), (2, 1, 3)])
def test_gaussian_log_densities_and_entropies_are_those_of_torch(
    kind: Callable[..., Any], shape: tuple[int, ...]
) -> None:
    actor = randomised(kind, 6, 3)
    x = torch.randn(*shape, 6, generator=seeded(2), dtype=torch.float64)
    reference = normal_of(actor, x)
    actions = torch.randn(*shape, 3, generator=seeded(3), dtype=torch.float64)
    log_density, entropy = actor(x, actions)
    torch.testing.assert_close(log_density, reference.log_prob(actions))
    torch.testing.assert_close(entropy, reference.entropy())


@ACTORS
def test_the_gradient_of_the_log_prob_is_that_of_torch(kind: Callable[..., Any]) -> None:
    actor = randomised(kind, 6, 4)
    x = torch.randn(7, 6, generator=seeded(2), dtype=torch.float64)
    if kind is categorical:
        actions = torch.randint(4, (7,), generator=seeded(3))
        reference: distributions.Distribution = distributions.Categorical(logits=actor.body(x))
    else:
        actions = torch.randn(7, 4, generator=seeded(3), dtype=torch.float64)
        reference = normal_of(actor, x)
    parameters = list(actor.parameters())
    log_prob, entropy = actor(x, actions)
    ours = torch.autograd.grad((log_prob + 0.1 * entropy).sum(), parameters, allow_unused=True)
    theirs = torch.autograd.grad(
        (reference.log_prob(actions) + 0.1 * reference.entropy()).sum(), parameters, allow_unused=True
    )
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other)


def test_a_nearly_certain_policy_has_finite_log_probabilities_entropy_and_gradients() -> None:
    actor = with_outputs(categorical(2, [4], 3, seeded(0)), [1e4, 0.0, -1e4])
    log_prob, entropy = actor(torch.zeros(3, 2), torch.arange(3))
    assert log_prob.tolist() == [0.0, -1e4, -2e4]
    assert entropy.tolist() == [0.0, 0.0, 0.0]
    (log_prob + entropy).sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in actor.parameters())
    assert actor.act(torch.zeros(100, 2), seeded(0)).tolist() == [0] * 100


def test_deviations_that_depend_on_the_state_have_bounds_beyond_which_nothing_is_learnt() -> None:
    actor = with_outputs(state_gaussian(2, [], 3, seeded(0)), [0.0, 0.0, 0.0, -90.0, 0.2, 90.0])
    x, expected = torch.zeros(4, 2), [LOWEST_LOG_STD, 0.2 * LOG_STD_GAIN + INITIAL_LOG_STD, HIGHEST_LOG_STD]
    log_prob, entropy = actor(x, torch.ones(4, 3))
    assert entropy.tolist() == pytest.approx([sum(expected) + 1.5 * (1.0 + math.log(2.0 * math.pi))] * 4, abs=1e-6)
    (log_prob + entropy).sum().backward()
    of_bias = list(actor.parameters())[-1].grad[3:].tolist()
    assert of_bias == pytest.approx([0.0, 4.0 * LOG_STD_GAIN * math.exp(-2.0 * expected[1]), 0.0])


def test_greedy_takes_the_most_probable_action_and_the_mean() -> None:
    softmax, normal = randomised(categorical, 6, 22), randomised(gaussian, 6, 3)
    x = torch.randn(50, 6, generator=seeded(4), dtype=torch.float64)
    assert torch.equal(softmax.act(x, None), softmax.body(x).argmax(-1))
    assert len(set(softmax.act(x, None).tolist())) > 1
    assert torch.equal(normal.act(x, None), normal.body(x))
    of_state = randomised(state_gaussian, 6, 3)
    assert torch.equal(of_state.act(x, None), of_state.body(x)[:, :3])
    fixed = with_outputs(categorical(3, [4], 4, seeded(0)), [0.0, 0.3, 2.0, 0.1])
    assert fixed.act(torch.zeros(2, 5, 3), None).tolist() == [[2] * 5] * 2
