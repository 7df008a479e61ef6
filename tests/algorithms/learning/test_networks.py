"""Networks: their layers and initial weights, activations, and networks of a user."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from algorithms.hyperparameters import NetworkSettings
from algorithms.learning.networks import CommandNetwork, make_network, mlp


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def linear_layers(network: nn.Module) -> list[nn.Linear]:
    return [module for module in network.modules() if isinstance(module, nn.Linear)]


@pytest.mark.parametrize("hidden", [[], [7], [64, 32], [32, 64, 16]])
def test_weights_begin_orthogonal_with_their_gains_and_biases_at_zero(hidden: list[int]) -> None:
    layers = linear_layers(mlp(15, hidden, 22, seeded(0), output_gain=0.01))
    assert len(layers) == len(hidden) + 1
    for layer in layers:
        gain = 0.01 if layer is layers[-1] else math.sqrt(2)
        small = layer.weight if layer.out_features <= layer.in_features else layer.weight.T
        torch.testing.assert_close(small @ small.T, gain**2 * torch.eye(len(small)), atol=1e-5, rtol=0.0)
        assert not layer.bias.any()


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
