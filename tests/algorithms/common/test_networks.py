"""Policies against probabilities written down and torch's own distributions."""

from __future__ import annotations

import math
import random
import re
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import scipy.stats
import torch
from torch import distributions, nn

from algorithms.common.hyperparameters import NetworkSettings
from algorithms.common.networks import ACTIVATIONS, CategoricalActor, CommandNetwork, GaussianActor, make_network, mlp
from algorithms.common.optimisers import Adam

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

# A test that samples with a fixed seed passes or fails for good; a correct sampler fails one seed in ten thousand.
SIGNIFICANCE = 1e-4


def categorical(inputs: int, hidden: list[int], actions: int, generator: torch.Generator) -> CategoricalActor:
    return CategoricalActor(mlp(inputs, hidden, actions, generator, output_gain=0.01))


def gaussian(inputs: int, hidden: list[int], actions: int, generator: torch.Generator) -> GaussianActor:
    return GaussianActor(mlp(inputs, hidden, actions, generator, output_gain=0.01), actions)


ACTORS = pytest.mark.parametrize("kind", [categorical, gaussian])


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def linear_layers(network: nn.Module) -> list[nn.Linear]:
    return [module for module in network.modules() if isinstance(module, nn.Linear)]


def with_outputs(actor: CategoricalActor | GaussianActor, outputs: list[float]) -> CategoricalActor | GaussianActor:
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
    actions = actor.sample(torch.zeros(draws, 3), seeded(seed))
    counts = np.bincount(actions.numpy(), minlength=len(probabilities))
    assert scipy.stats.chisquare(counts, draws * np.array(probabilities)).pvalue > SIGNIFICANCE


def test_every_row_is_drawn_independently_from_its_own_probabilities() -> None:
    actor = categorical(2, [], 3, seeded(0))
    logits = torch.tensor([[1.0, -1.0, 0.0], [-2.0, 0.5, 0.0]])
    with torch.no_grad():
        linear_layers(actor.body)[0].weight.copy_(logits.T)
    rounds = 20_000
    actions = actor.sample(torch.eye(2).repeat(rounds, 1, 1), seeded(3))
    assert actions.shape == (rounds, 2)
    pairs = np.bincount(3 * actions[:, 0].numpy() + actions[:, 1].numpy(), minlength=9)
    first, second = logits.softmax(-1).double().numpy()
    expected = np.outer(first, second).ravel()
    assert scipy.stats.chisquare(pairs, rounds * expected / expected.sum()).pvalue > SIGNIFICANCE


def test_an_action_without_probability_is_never_drawn() -> None:
    actor = with_outputs(categorical(3, [4], 3, seeded(0)), [0.0, -200.0, 0.0])
    assert not (actor.sample(torch.zeros(20_000, 3), seeded(0)) == 1).any()


@pytest.mark.parametrize("seed", range(3))
def test_continuous_actions_are_drawn_from_the_normal_distribution(seed: int) -> None:
    actor = with_outputs(gaussian(3, [4], 2, seeded(0)), [0.3, -2.0])
    with torch.no_grad():
        actor.log_std.copy_(torch.tensor([-0.5, 0.7]))
    actions = actor.sample(torch.zeros(20_000, 3), seeded(seed)).detach().numpy()
    for axis, (mean, log_std) in enumerate([(0.3, -0.5), (-2.0, 0.7)]):
        assert scipy.stats.kstest(actions[:, axis], "norm", (mean, math.exp(log_std))).pvalue > SIGNIFICANCE
    assert scipy.stats.pearsonr(actions[:, 0], actions[:, 1]).pvalue > SIGNIFICANCE


def randomised(kind: Callable[..., Any], inputs: int, actions: int) -> CategoricalActor | GaussianActor:
    """An actor far from its initial, nearly uniform policy."""
    actor = kind(inputs, [16, 8], actions, seeded(1))
    with torch.no_grad():
        linear_layers(actor.body)[-1].weight.mul_(200.0)
        if isinstance(actor, GaussianActor):
            actor.log_std.copy_(torch.linspace(-2.0, 1.0, actions))
    return actor.double()


@pytest.mark.parametrize("shape", [(), (5,), (4, 3), (2, 1, 3)])
def test_categorical_log_probabilities_and_entropies_are_those_of_torch(shape: tuple[int, ...]) -> None:
    actor = randomised(categorical, 6, 22)
    x = torch.randn(*shape, 6, generator=seeded(2), dtype=torch.float64)
    reference = distributions.Categorical(logits=actor.body(x))
    actions = torch.randint(22, shape, generator=seeded(3))
    log_prob, entropy = actor.log_prob_and_entropy(x, actions)
    torch.testing.assert_close(log_prob, reference.log_prob(actions))
    torch.testing.assert_close(entropy, reference.entropy())


@pytest.mark.parametrize("shape", [(), (5,), (4, 3), (2, 1, 3)])
def test_gaussian_log_densities_and_entropies_are_those_of_torch(shape: tuple[int, ...]) -> None:
    actor = randomised(gaussian, 6, 3)
    x = torch.randn(*shape, 6, generator=seeded(2), dtype=torch.float64)
    reference = distributions.Independent(distributions.Normal(actor.body(x), actor.log_std.exp()), 1)
    actions = torch.randn(*shape, 3, generator=seeded(3), dtype=torch.float64)
    log_density, entropy = actor.log_prob_and_entropy(x, actions)
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
        reference = distributions.Independent(distributions.Normal(actor.body(x), actor.log_std.exp()), 1)
    parameters = list(actor.parameters())
    log_prob, entropy = actor.log_prob_and_entropy(x, actions)
    ours = torch.autograd.grad((log_prob + 0.1 * entropy).sum(), parameters, allow_unused=True)
    theirs = torch.autograd.grad(
        (reference.log_prob(actions) + 0.1 * reference.entropy()).sum(), parameters, allow_unused=True
    )
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other)


def test_a_nearly_certain_policy_has_finite_log_probabilities_entropy_and_gradients() -> None:
    actor = with_outputs(categorical(2, [4], 3, seeded(0)), [1e4, 0.0, -1e4])
    log_prob, entropy = actor.log_prob_and_entropy(torch.zeros(3, 2), torch.arange(3))
    assert log_prob.tolist() == [0.0, -1e4, -2e4]
    assert entropy.tolist() == [0.0, 0.0, 0.0]
    (log_prob + entropy).sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in actor.parameters())
    assert actor.sample(torch.zeros(100, 2), seeded(0)).tolist() == [0] * 100


def test_greedy_takes_the_most_probable_action_and_the_mean() -> None:
    softmax, normal = randomised(categorical, 6, 22), randomised(gaussian, 6, 3)
    x = torch.randn(50, 6, generator=seeded(4), dtype=torch.float64)
    assert torch.equal(softmax.greedy(x), softmax.body(x).argmax(-1))
    assert len(set(softmax.greedy(x).tolist())) > 1
    assert torch.equal(normal.greedy(x), normal.body(x))
    fixed = with_outputs(categorical(3, [4], 4, seeded(0)), [0.0, 0.3, 2.0, 0.1])
    assert fixed.greedy(torch.zeros(2, 5, 3)).tolist() == [[2] * 5] * 2


@ACTORS
@pytest.mark.parametrize("shape", [(), (5,), (4, 3)])
def test_actions_have_one_row_per_row_of_inputs(kind: type, shape: tuple[int, ...]) -> None:
    actor = kind(6, [8], 3, seeded(0))
    x = torch.zeros(*shape, 6)
    expected = shape if kind is categorical else (*shape, 3)
    for actions in (actor.sample(x, seeded(0)), actor.greedy(x)):
        assert actions.shape == expected
        assert actions.dtype == (torch.int64 if kind is categorical else torch.float32)


@ACTORS
def test_the_generator_determines_weights_and_samples(kind: Callable[..., Any]) -> None:
    actors = [kind(6, [64, 32], 4, seeded(seed)) for seed in (7, 7, 8)]
    states = [actor.state_dict() for actor in actors]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert not torch.equal(states[0]["body.0.weight"], states[2]["body.0.weight"])
    x = torch.zeros(100, 6)
    samples = [actors[0].sample(x, seeded(seed)) for seed in (7, 7, 8)]
    assert torch.equal(samples[0], samples[1])
    assert not torch.equal(samples[0], samples[2])


@ACTORS
def test_successive_draws_from_one_generator_differ(kind: Callable[..., Any]) -> None:
    generator = seeded(7)
    first, second = kind(6, [8], 4, generator), kind(6, [8], 4, generator)
    assert not torch.equal(linear_layers(first)[0].weight, linear_layers(second)[0].weight)
    x = torch.zeros(100, 6)
    assert not torch.equal(first.sample(x, generator), first.sample(x, generator))


def test_a_network_is_linear_layers_with_relu_between_them() -> None:
    network = mlp(15, [64, 32], 22, seeded(0), output_gain=1.0)
    kinds = [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear]
    assert all(isinstance(module, kind) for module, kind in zip(network, kinds, strict=True))
    shapes = [(layer.in_features, layer.out_features) for layer in linear_layers(network)]
    assert shapes == [(15, 64), (64, 32), (32, 22)]
    x = torch.randn(10, 15, generator=seeded(1))
    (first, second, third) = [(layer.weight, layer.bias) for layer in linear_layers(network)]
    hidden = (x @ first[0].T + first[1]).clamp(min=0.0)
    hidden = (hidden @ second[0].T + second[1]).clamp(min=0.0)
    torch.testing.assert_close(network(x), hidden @ third[0].T + third[1])


@pytest.mark.parametrize("hidden", [[], [7], [64, 32], [32, 64, 16]])
def test_weights_begin_orthogonal_with_their_gains_and_biases_at_zero(hidden: list[int]) -> None:
    layers = linear_layers(mlp(15, hidden, 22, seeded(0), output_gain=0.01))
    assert len(layers) == len(hidden) + 1
    for layer in layers:
        gain = 0.01 if layer is layers[-1] else math.sqrt(2)
        small = layer.weight if layer.out_features <= layer.in_features else layer.weight.T
        torch.testing.assert_close(small @ small.T, gain**2 * torch.eye(len(small)), atol=1e-5, rtol=0.0)
        assert not layer.bias.any()


def test_policies_begin_nearly_uniform_and_nearly_centred() -> None:
    x = torch.randn(100, 15, generator=seeded(1))
    probabilities = categorical(15, [64, 32], 22, seeded(0)).body(x).softmax(-1)
    assert (probabilities * 22 - 1).abs().max() < 0.1
    means = gaussian(15, [64, 32], 3, seeded(0))
    assert means.greedy(x).abs().max() < 0.1
    assert torch.equal(means.log_std, torch.full((3,), -0.5))


def everything(kind: Callable[..., Any]) -> Callable[[], None]:
    def use() -> None:
        actor = kind(6, [8], 4, seeded(0))
        x = torch.zeros(10, 6)
        actions = actor.sample(x, seeded(1))
        actor.greedy(x)
        log_prob, entropy = actor.log_prob_and_entropy(x, actions)
        (log_prob + entropy).sum().backward()
        mlp(6, [8, 8], 2, seeded(0), output_gain=1.0)

    return use


@ACTORS
def test_neither_building_nor_sampling_touches_any_global_generator(kind: Callable[..., Any]) -> None:
    before = torch.get_rng_state(), random.getstate(), np.random.get_state()[1].copy()  # noqa: NPY002
    everything(kind)()
    assert torch.equal(torch.get_rng_state(), before[0])
    assert random.getstate() == before[1]
    assert np.array_equal(np.random.get_state()[1], before[2])  # noqa: NPY002


@ACTORS
def test_the_global_seed_does_not_matter(kind: Callable[..., Any]) -> None:
    results = []
    state = torch.get_rng_state()
    for seed in (0, 1):
        torch.manual_seed(seed)
        actor = kind(6, [8], 4, seeded(0))
        results.append((actor.state_dict(), actor.sample(torch.zeros(10, 6), seeded(1))))
    torch.set_rng_state(state)
    assert all(torch.equal(results[0][0][name], results[1][0][name]) for name in results[0][0])
    assert torch.equal(results[0][1], results[1][1])


# --------------------------------------------------------------------------------- activations and networks of a user

NETWORKS = """
import torch
from torch import nn

def layer_norm(inputs, outputs, generator):
    return nn.Sequential(nn.Linear(inputs, 7), nn.LayerNorm(7), nn.Tanh(), nn.Linear(7, outputs))

def seeded(inputs, outputs, generator):
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, generator=generator)
    return layer

def wrong_shape(inputs, outputs, generator):
    return nn.Linear(inputs, outputs + 1)

def wrong_type(inputs, outputs, generator):
    return lambda x: x

def dropout(inputs, outputs, generator):
    return nn.Sequential(nn.Linear(inputs, outputs), nn.Dropout(0.5))

def frozen(inputs, outputs, generator):
    layers = nn.Sequential(nn.Linear(inputs, 4), nn.Linear(4, outputs))
    layers[0].requires_grad_(False)
    return layers

def broken(inputs, outputs, generator):
    raise RuntimeError("no\\nnetwork")
"""


@pytest.fixture
def users_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module users_networks, which can be imported in this test."""
    (tmp_path / "users_networks.py").write_text(NETWORKS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "users_networks", raising=False)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_an_activation_is_chosen_by_name(name: Any) -> None:
    network = make_network(NetworkSettings(hidden=[8, 4], activation=name), 3, 2, seeded(0))
    assert [type(module) for module in network if not isinstance(module, nn.Linear)] == 2 * [ACTIVATIONS[name]]


@pytest.mark.usefixtures("users_module")
@pytest.mark.parametrize("function", ["layer_norm", "seeded"])
def test_a_users_network_is_determined_by_the_generator(function: str) -> None:
    config = NetworkSettings(network=f"users_networks:{function}")
    before = torch.get_rng_state()
    first, second, other = (make_network(config, 3, 2, seeded(seed)).state_dict() for seed in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


@pytest.mark.usefixtures("users_module")
@pytest.mark.parametrize(
    ("path", "message"),
    [
        (
            "no_such_module:f",
            "'no_such_module' cannot be imported: ModuleNotFoundError: No module named 'no_such_module'",
        ),
        (
            "users_networks:seedet",
            "'users_networks' has no 'seedet'; did you mean 'seeded'? known: broken, dropout, ",
        ),
        (
            "users_networks:wrong_shape",
            "(3, 2, generator) cannot be used: TypeError: it maps shape (3, 2, 3) to (3, 2, 3), not (3, 2, 2)",
        ),
        ("users_networks:wrong_type", "(3, 2, generator) cannot be used: TypeError: it returns <function"),
        ("users_networks:broken", "(3, 2, generator) cannot be used: RuntimeError: no network"),
        (
            "users_networks:dropout",
            "(3, 2, generator) cannot be used: TypeError: the network draws random numbers when",
        ),
        (
            "users_networks:frozen",
            "(3, 2, generator) cannot be used: TypeError: the network does not learn its parameters ",
        ),
    ],
)
def test_a_users_network_that_cannot_be_used_is_refused_in_one_line(path: str, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"algorithm.network = {path!r}: {message}")) as caught:
        make_network(NetworkSettings(network=path), 3, 2, seeded(0))
    assert "\n" not in str(caught.value)


# The network of PCN.


@pytest.mark.parametrize("rows", [1, 16, CommandNetwork.FEW_ROWS, CommandNetwork.FEW_ROWS + 1])
@pytest.mark.parametrize("hidden", [[8], [16, 8, 4]])
def test_a_command_network_responds_with_what_its_forward_pass_gives(hidden: list[int], rows: int) -> None:
    generator = torch.Generator().manual_seed(0)
    network = CommandNetwork(5, 3, hidden, 4, generator)
    for scale in (1.0, 100.0):  # the latter saturates the sigmoids
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.normal_(0.0, 1.0, generator=generator)
        observations, commands = (scale * torch.randn(rows, width, generator=generator) for width in (5, 3))
        found = network.respond(observations.numpy(), commands.numpy())
        assert found.dtype == np.float32
        expected = network(observations, commands).detach().numpy()
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_a_command_network_responds_with_the_parameters_of_now() -> None:
    network = CommandNetwork(2, 2, [8, 8], 3, torch.Generator().manual_seed(0))
    x = np.ones((4, 2), dtype=np.float32)
    network.respond(x, x)
    optimiser = Adam(network.parameters())  # moves them
    for _ in range(3):
        optimiser.minimise(network(torch.from_numpy(x), torch.from_numpy(x)).square().sum(), 0.1)
        expected = network(torch.from_numpy(x), torch.from_numpy(x)).detach().numpy()
        np.testing.assert_allclose(network.respond(x, x), expected, rtol=1e-4, atol=1e-6)
