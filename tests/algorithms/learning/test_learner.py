"""Gradient steps of several seeds against torch's Adam, and the state of a learner."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import nn

from algorithms.actor_critic import MEMORY, PolicyLearner
from algorithms.learning.learner import NORM, Learner, Networks
from algorithms.learning.losses import Loss
from algorithms.learning.networks import mlp

RATE = torch.tensor(0.01)


def network_of(seed: int = 0) -> nn.Sequential:
    return mlp(5, (8, 4), 3, torch.Generator().manual_seed(seed), output_gain=1.0)


def learner_of(*seeds: int, max_grad_norm: float = 0.7) -> Learner:
    return Learner([Networks(body=network_of(seed)) for seed in seeds], max_grad_norm, "learner")


def problem(*seeds: int, batch: int = 0) -> dict[str, torch.Tensor]:
    parts = []
    for seed in seeds:
        generator = torch.Generator().manual_seed(100 * seed + batch)
        parts.append((torch.randn(16, 5, generator=generator), torch.randn(16, 3, generator=generator)))
    return {"x": torch.stack([x for x, _ in parts]), "y": torch.stack([y for _, y in parts])}


def squared(networks: Any, samples: dict[str, torch.Tensor]) -> Loss:
    total = (networks.body(samples["x"]) - samples["y"]).square().mean()
    return Loss(total, {"loss": total})


@pytest.mark.parametrize("seeds", [(0,), (0, 1, 2)])
def test_the_steps_are_those_of_torchs_adam_after_clipping_the_norm(seeds: tuple[int, ...]) -> None:
    learner, references = learner_of(*seeds), [network_of(seed) for seed in seeds]
    optimisers = [torch.optim.Adam(each.parameters(), lr=0.01) for each in references]
    clipped = []
    for batch in range(20):
        samples = problem(*seeds, batch=batch)
        parts = learner.minimise(squared, samples, [], RATE)
        for seed, (reference, optimiser) in enumerate(zip(references, optimisers, strict=True)):
            optimiser.zero_grad()
            loss = (reference(samples["x"][seed]) - samples["y"][seed]).square().mean()
            loss.backward()
            norm = float(nn.utils.clip_grad_norm_(reference.parameters(), 0.7))
            optimiser.step()
            clipped.append(norm > 0.7)
            assert float(parts[NORM][seed]) == pytest.approx(norm, rel=1e-4)
            assert float(parts["loss"][seed]) == pytest.approx(float(loss.detach()), rel=1e-4)
    assert 0 < sum(clipped) < len(clipped)
    for seed, reference in enumerate(references):
        state = learner.get_state(seed)
        for name, parameter in reference.named_parameters():
            torch.testing.assert_close(state[f"body.{name}"], parameter.data, rtol=1e-4, atol=1e-5)


def test_a_loss_is_of_the_rows_that_are_chosen_for_each_seed() -> None:
    rows = torch.tensor([[0, 3, 5], [1, 1, 2]])
    chosen, apart = learner_of(0, 1), learner_of(0, 1)
    samples = problem(0, 1)
    chosen.minimise(squared, samples, [rows], RATE)
    picked = {name: torch.stack([each[seed, rows[seed]] for seed in range(2)]) for name, each in samples.items()}
    apart.minimise(squared, picked, [], RATE)
    torch.testing.assert_close(chosen.vector, apart.vector)


def test_a_seed_whose_gradient_is_0_or_not_finite_stays_where_it_is() -> None:
    def broken(networks: Any, samples: dict[str, torch.Tensor]) -> Loss:
        total = networks.body(samples["x"]).mean() * samples["factor"][0]
        return Loss(total, {"loss": total})

    learner = learner_of(0, 1, 2, 3)
    before = [each.clone() for each in learner.state]
    factors = torch.tensor([[math.nan], [0.0], [math.inf], [1.0]])
    parts = learner.minimise(broken, {**problem(0, 1, 2, 3), "factor": factors}, [], RATE)
    for old, new in zip(before, learner.state, strict=True):
        assert torch.equal(old[:3], new[:3])
        assert not torch.equal(old[3], new[3])
    assert parts[NORM].isfinite().tolist() == [False, True, False, True]


def test_a_restored_learner_takes_the_same_steps_whatever_its_place_among_the_seeds() -> None:
    learner, restored = learner_of(0, 1), learner_of(2, 3)
    learner.minimise(squared, problem(0, 1), [], RATE)
    for seed in range(2):
        state = {name: tensor.clone() for name, tensor in learner.get_state(seed).items()}
        restored.set_state(state, 1 - seed)
    learner.minimise(squared, problem(4, 5), [], RATE)
    restored.minimise(squared, problem(5, 4), [], RATE)
    for one, other in zip(learner.state, restored.state, strict=True):
        assert torch.equal(one, other.flip(0))


def test_the_expected_return_is_an_exponentially_weighted_mean_of_episodes() -> None:
    learner = PolicyLearner([Networks(actor=network_of(), critic=network_of())], 1.0, (0,), 2)

    def note(*values: list[float]) -> list[float]:
        ended = torch.tensor([True] * len(values) + [False] * (3 - len(values))).view(1, 3, 1)
        padded = torch.tensor([*values, *[[99.0, 99.0]] * (3 - len(values))]).view(1, 3, 1, 2)
        learner.update_on_episode_end(padded, ended)
        return learner.expected_return[0].tolist()

    assert note() == [0.0, 0.0]
    assert note([1.0, 4.0], [3.0, 0.0]) == [2.0, 2.0]
    assert note([12.0, 2.0], [2.0, 2.0]) == pytest.approx([MEMORY**2 * 2.0 + (1 - MEMORY**2) * 7.0, 2.0])
    assert learner.episodes.tolist() == [4]
