"""The equations that one reads are those that run: as they are, compiled, and with seeds side by side."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

import algorithms.agent
from algorithms import MOPPO, PCN
from algorithms.learning import compiling
from algorithms.runs.build import build
from algorithms.runs.onnx_export import TOLERANCE, export_onnx
from tests.helpers.agents import CONTINUOUS, ONE_WAYPOINT, SEA, make_agent, same, state
from tests.helpers.own_algorithms import (
    AdvantagesInPlace,
    CommandsInPlace,
    Deciding,
    LossInPlace,
    Squared,
    Stubborn,
    deciding_utility,
)
from tests.helpers.seed_trainers import LEARNERS, TOTAL, trainer
from tests.helpers.short_agents import STEPS, pair_experiment

SMALL: dict[str, Any] = {"hidden": [16], "steps": 8}
MODES: dict[str, dict[str, Any]] = {
    "eager": {"seed": 3, "compiled": False},
    "compiled": {"seed": 3, "compiled": True},
    "side by side": {"seed": [3, 4], "compiled": False},
    "side by side, compiled": {"seed": [3, 4], "compiled": True},
}


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is to be compiled is traced, and then run as it is: without a compiler, which would round otherwise."""
    monkeypatch.setattr(compiling, "BACKEND", "aot_eager")
    monkeypatch.setattr(algorithms.agent, "has_compiler", lambda _: True)


def learnt(cls: type[MOPPO], mode: str) -> dict[str, torch.Tensor]:
    """What the seed 3 has learnt in an update."""
    agent = make_agent(cls, **SMALL, **MODES[mode])
    agent.train(64, after_update=lambda _: True)
    return state(agent)


@pytest.mark.slow
@pytest.mark.usefixtures("traced")
@pytest.mark.parametrize("cls", [Stubborn, Squared])
@pytest.mark.parametrize("mode", MODES)
def test_a_changed_formula_shows_in_every_mode(cls: type[MOPPO], mode: str) -> None:
    plain = mode.removesuffix("compiled").strip(", ") or "eager"
    changed, expected, unchanged = learnt(cls, mode), learnt(cls, plain), learnt(MOPPO, plain)
    assert same(changed, expected)
    assert not torch.allclose(changed["0.actor.body.0.weight"], unchanged["0.actor.body.0.weight"], atol=1e-4)


PCNS: dict[str, dict[str, Any]] = {"pcn": {}, "pcn, continuous": CONTINUOUS}


def after_one_update(name: str, seed: Any, *, compiled: bool) -> Any:
    """An agent of one of LEARNERS or PCNS."""
    if name in PCNS:
        env = {"time_limit": 1, "fixed_destination": True, **PCNS[name]}
        size = {"hidden": [8, 8], "gradient_steps": 3, "warmup_episodes": 4, "batch_size": 32}
        agent = make_agent(PCN, ONE_WAYPOINT, env=env, compiled=compiled, **size)
    else:
        agent = trainer(name, seed, compiled=compiled)
    agent.train(TOTAL, after_update=lambda _: True)
    return agent


@pytest.mark.slow
@pytest.mark.usefixtures("traced")
@pytest.mark.parametrize("name", [*LEARNERS, *PCNS])
def test_a_traced_update_is_the_one_that_is_not_traced(name: str) -> None:
    one, other = (after_one_update(name, [3, 4], compiled=compiled) for compiled in (True, False))
    for mine, theirs in zip(one.learners, other.learners, strict=True):
        assert torch.equal(mine.vector, theirs.vector)


@pytest.mark.slow
@pytest.mark.skipif(not compiling.has_compiler("cpu"), reason="there is no C++ compiler")
@pytest.mark.parametrize(  # every loss and every distribution of actions; each takes seconds
    ("name", "seeds"),
    [("mo_a2c, as printed", [3]), ("ppo, continuous", [3]), ("mocac", [3]), ("mappo", [3, 4]), ("pcn", [3])],
)
def test_a_compiled_update_is_the_one_that_is_not_compiled_but_for_rounding(name: str, seeds: list[int]) -> None:
    one, other = (after_one_update(name, seeds, compiled=compiled) for compiled in (True, False))
    for mine, theirs in zip(one.learners, other.learners, strict=True):
        torch.testing.assert_close(mine.mean, theirs.mean, rtol=1e-3, atol=1e-6)
        torch.testing.assert_close(mine.vector, theirs.vector, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_a_changed_loss_is_trained_with_partners_for_several_seeds_resumed_and_exported(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    partners = {"vehicle_1": ["rule:straight_6"]}
    experiment = pair_experiment("tests.helpers.own_algorithms:Stubborn", partners=partners)
    agent, resumed = build(experiment, seeds=[3, 4]), build(experiment, seeds=[8, 9])
    rows: list[Any] = []
    agent.train(STEPS, log=[lambda *_: None, lambda _, row: rows.append(row)], log_interval=1)
    assert rows[-1]["vehicle_0/loss/stay"] > 0.0
    paths = [tmp_path / f"{seed}.safetensors" for seed in agent.seeds]
    for seed, path in enumerate(paths):
        agent.save(path, seed=seed)
    resumed.load(*paths)
    assert resumed.seeds == (3, 4)
    assert torch.equal(resumed.learners[0].vector, agent.learners[0].vector)
    policy = build(experiment, num_envs=1)
    policy.load(paths[1], policy_only=True)
    assert same(policy.get_policy(), agent.of_seed(1).get_policy())
    exported = export_onnx(policy, experiment, tmp_path / "policy.onnx")
    assert exported.difference is not None
    assert exported.difference < TOLERANCE


IN_PLACE = "must not change its tensors in place, as it does"
SIDE_BY_SIDE = "an update cannot be calculated for several seeds at once, because of own_algorithms.py:"
HERE = "tests.helpers.own_algorithms"
REFUSED: dict[str, tuple[type[Any], dict[str, Any], list[str], str]] = {
    "a loss in place": (LossInPlace, SMALL, [*MODES], f"a loss {IN_PLACE} 'advantages'; write x = x + y"),
    "advantages in place": (AdvantagesInPlace, SMALL, [*MODES], f"an advantage {IN_PLACE} 'rewards'; write x = x + y"),
    "a loss of PCN in place": (
        CommandsInPlace,
        {"env_id": SEA, "hidden": [8, 8], "warmup_episodes": 4},
        ["eager", "compiled"],
        f"a loss {IN_PLACE} 'commands'",
    ),
    "a loss of values, compiled": (
        Deciding,
        SMALL,
        ["compiled"],
        "training.compiled = True: this update cannot be compiled, because of own_algorithms.py:",
    ),
    "a loss of values": (Deciding, SMALL, ["side by side", "side by side, compiled"], SIDE_BY_SIDE),
    "a network of values": (MOPPO, {**SMALL, "network": f"{HERE}:deciding_network"}, ["side by side"], SIDE_BY_SIDE),
    "a utility of values": (
        MOPPO,
        {**SMALL, "utility": deciding_utility},
        ["side by side"],
        "utility 'deciding_utility' cannot be calculated for several seeds at once, because of own_algorithms",
    ),
}


@pytest.mark.usefixtures("traced")
@pytest.mark.parametrize(("case", "mode"), [(case, mode) for case in REFUSED for mode in REFUSED[case][2]])
def test_what_cannot_be_learnt_from_is_refused_at_the_first_update_with_what_to_do(case: str, mode: str) -> None:
    cls, settings, _, message = REFUSED[case]
    with pytest.raises(ValueError, match=r"^[^\n]+$") as refused:
        make_agent(cls, **settings, **MODES[mode]).train(10_000, after_update=lambda _: True)
    assert message in str(refused.value)


@pytest.mark.usefixtures("traced")
def test_what_cannot_be_compiled_is_learnt_from_as_it_is_where_it_need_not_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(algorithms.agent.WORTHWHILE, "cpu", 0.0)
    found = []
    for compiled in (False, "auto"):
        agent = make_agent(Deciding, **SMALL, compiled=compiled)
        agent.train(64)
        assert agent.learners[0].compiled == compiled
        found.append(state(agent))
    assert same(*found)


def test_training_is_not_compiled_without_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    monkeypatch.setitem(algorithms.agent.WORTHWHILE, "cpu", 0.0)
    agent = make_agent(MOPPO, **SMALL, compiled=True)
    with pytest.raises(ValueError, match=r"^training.compiled = True needs a C\+\+ compiler such as g\+\+, [^\n]+$"):
        agent.train(64)
    assert agent.step == 0
    agent = make_agent(MOPPO, **SMALL, compiled="auto")
    agent.train(64)
    assert agent.learners[0].compiled is False
