"""The equations that one reads are those that run: as they stand, compiled, and with seeds side by side."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from algorithms import MAPPO, MOPPO
from algorithms.learning.compiling import has_compiler
from algorithms.learning.losses import Loss
from tests.helpers.agents import INTERSECTION, make_agent

COMPILER = pytest.mark.skipif(not has_compiler("cpu"), reason="there is no C++ compiler")
MODES: dict[str, dict[str, Any]] = {
    "as it stands": {"compiled": False},
    "with seeds side by side": {"compiled": False, "seed": [3, 4]},
    "compiled": {"compiled": True},
    "compiled, with seeds side by side": {"compiled": True, "seed": [3, 4]},
}
EVERY_MODE = pytest.mark.parametrize(
    "mode",
    [pytest.param(mode, marks=[COMPILER, pytest.mark.slow] if MODES[mode]["compiled"] else []) for mode in MODES],
)
SMALL: dict[str, Any] = {"hidden": [8], "steps": 4, "epochs": 1, "minibatches": 1, "seed": 3}


class OtherLoss(MOPPO):
    """Of twice the loss of the critic."""

    def loss(self, networks: Any, samples: Any, entropy_coefficient: Any) -> Loss:
        found = super().loss(networks, samples, entropy_coefficient)
        more = found.parts["loss/value"]
        return Loss(found.total + more, {**found.parts, "loss/value": 2.0 * more})


class OtherAdvantages(MOPPO):
    """Of targets that are further from the values."""

    def advantages(self, rollout: Any, values: Any, next_values: Any) -> Any:
        advantages, targets = super().advantages(rollout, values, next_values)
        return advantages, targets + 100.0


class DependsOnValues(MOPPO):
    """Of a loss that decides by the values of its samples."""

    def loss(self, networks: Any, samples: Any, entropy_coefficient: Any) -> Loss:
        found = super().loss(networks, samples, entropy_coefficient)
        return found if found.total > 0.0 else found._replace(total=2.0 * found.total)


class ChangesSamples(MOPPO):
    """Of a loss that changes its samples."""

    def loss(self, networks: Any, samples: Any, entropy_coefficient: Any) -> Loss:
        samples.advantages.clamp_(-1.0, 1.0)
        return super().loss(networks, samples, entropy_coefficient)


def learnt(cls: Any, env_id: str | None = None, **options: Any) -> tuple[Any, dict[str, Any]]:
    """An agent after one update, and its losses."""
    where = [env_id] if env_id else []
    agent = make_agent(cls, *where, **{**SMALL, **options})
    agent.train(16, after_update=lambda _: True)
    return agent, agent._losses


@EVERY_MODE
def test_a_changed_loss_and_changed_advantages_are_learnt_from_in_every_mode(mode: str) -> None:
    plain, losses = learnt(MOPPO, **MODES[mode])
    for cls in (OtherLoss, OtherAdvantages):
        changed, others = learnt(cls, **MODES[mode])
        assert not torch.equal(plain.learners[0].vector, changed.learners[0].vector)
        assert (others["loss/value"] > 1.5 * losses["loss/value"]).all()
        assert torch.equal(others["policy/entropy"], losses["policy/entropy"])


@pytest.mark.slow
@COMPILER
@pytest.mark.parametrize(("cls", "where", "seed"), [(MOPPO, None, 3), (MAPPO, INTERSECTION, [3, 4])])
def test_a_compiled_update_is_the_one_that_is_not_compiled_but_for_rounding(cls: Any, where: Any, seed: Any) -> None:
    (one, losses), (other, others) = (learnt(cls, where, seed=seed, compiled=each) for each in (True, False))
    for name, each in losses.items():
        torch.testing.assert_close(each, others[name], rtol=1e-4, atol=1e-5)
    for mine, theirs in zip(one.learners, other.learners, strict=True):
        torch.testing.assert_close(mine.mean, theirs.mean, rtol=1e-3, atol=1e-6)


def looking(returns: Any) -> Any:
    """A utility that decides by the values of its returns."""
    return returns.sum(-1) if (returns >= 0.0).all() else returns[..., 0]


REFUSED: dict[str, tuple[Any, dict[str, Any], str]] = {
    "a loss that depends on values, of several seeds": (
        DependsOnValues,
        {"seed": [3, 4]},
        "cannot be calculated for several seeds at once, because of test_one_road.py:",
    ),
    "a loss that depends on values, compiled": (
        DependsOnValues,
        {"compiled": True},
        "cannot be compiled, because of test_one_road.py:",
    ),
    "a loss that changes its samples": (
        ChangesSamples,
        {},
        "a loss must not change its tensors in place, as it does 'advantages'; write x = x + y in place of x += y",
    ),
    "a loss that changes its samples, of several seeds": (
        ChangesSamples,
        {"seed": [3, 4]},
        "a loss must not change its tensors in place, as it does 'advantages'; write x = x + y in place of x += y",
    ),
    "a loss that changes its samples, compiled": (
        ChangesSamples,
        {"compiled": True},
        "a loss must not change its tensors in place, as it does 'advantages'; write x = x + y in place of x += y",
    ),
    "a utility that depends on values, of several seeds": (
        MOPPO,
        {"seed": [3, 4], "utility": looking},
        "cannot be calculated for several seeds at once, because of test_one_road.py:",
    ),
}


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=[COMPILER] if REFUSED[case][1].get("compiled") else []) for case in REFUSED],
)
def test_what_cannot_be_learnt_from_is_refused_at_the_first_update_with_what_to_do(case: str) -> None:
    cls, options, message = REFUSED[case]
    with pytest.raises(ValueError, match=r"^[^\n]+$") as refused:
        learnt(cls, **{"compiled": False, **options})
    assert message in str(refused.value)


def test_the_same_loss_is_learnt_from_by_one_seed_as_it_stands() -> None:
    learnt(DependsOnValues, compiled=False)


def test_training_is_not_compiled_without_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("algorithms.agent.has_compiler", lambda _: False)
    with pytest.raises(ValueError, match=r"^training.compiled = True needs a C\+\+ compiler such as g\+\+, [^\n]+$"):
        learnt(MOPPO, compiled=True)
    learnt(MOPPO, compiled="auto")
