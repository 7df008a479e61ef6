"""What one reads is what runs: a formula that is changed shows in every mode, or is refused in one line."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

import algorithms.agent
from algorithms import MOPPO
from algorithms.experiments.build import build
from algorithms.experiments.onnx_export import TOLERANCE, export_onnx
from algorithms.learning import compiling
from tests.helpers.agents import SEA, make_agent, state
from tests.helpers.own_algorithms import (
    AdvantagesInPlace,
    CommandsInPlace,
    Deciding,
    LossInPlace,
    Squared,
    Stubborn,
    deciding_utility,
)
from tests.helpers.short_agents import STEPS, pair_experiment

HERE = "tests.helpers.own_algorithms"
SMALL: dict[str, Any] = {"hidden": [16], "steps": 8}
MODES: dict[str, dict[str, Any]] = {
    "eager": {"seed": 3, "compiled": False},
    "compiled": {"seed": 3, "compiled": True},
    "side by side": {"seed": [3, 4], "compiled": False},
    "side by side, compiled": {"seed": [3, 4], "compiled": True},
}


def learnt(cls: type[MOPPO], mode: str) -> torch.Tensor:
    """The parameters of the seed 3 after few steps, in which rounding has not grown."""
    agent = make_agent(cls, **SMALL, minibatches=1, epochs=3, **MODES[mode])
    agent.train(32)
    return agent.learners[0].vector[0].clone()


def check_changed(cls: type[MOPPO], mode: str) -> None:
    uncompiled = mode.removesuffix("compiled").strip(", ") or "eager"
    plain, changed, expected = learnt(MOPPO, uncompiled), learnt(cls, mode), learnt(cls, uncompiled)
    assert (plain - changed).abs().max() > 1e-4
    torch.testing.assert_close(changed, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("cls", [Stubborn, Squared])
@pytest.mark.parametrize("mode", MODES)
def test_a_changed_formula_shows_in_every_mode(cls: type[MOPPO], mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(algorithms.agent, "has_compiler", lambda _: True)
    monkeypatch.setattr(compiling, "BACKEND", "aot_eager")  # traces, and compiles nothing
    check_changed(cls, mode)


@pytest.mark.slow
@pytest.mark.skipif(not compiling.has_compiler("cpu"), reason="there is no C++ compiler")
def test_a_changed_loss_is_compiled() -> None:
    check_changed(Stubborn, "compiled")


@pytest.mark.slow
def test_a_changed_loss_is_trained_with_partners_for_several_seeds_resumed_and_exported(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    experiment = pair_experiment(f"{HERE}:Stubborn", partners={"vehicle_1": ["rule:straight_6"]})
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
    assert torch.equal(policy.learners[0].actor.body[0].weight, agent.of_seed(1).learners[0].actor.body[0].weight)
    exported = export_onnx(policy, experiment, tmp_path / "policy.onnx")
    assert exported.difference is not None
    assert exported.difference < TOLERANCE


def test_a_loss_that_decides_by_values_is_taken_as_it_is_where_it_need_not_be_compiled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(algorithms.agent, "has_compiler", lambda _: True)
    monkeypatch.setitem(algorithms.agent.WORTHWHILE, "cpu", 0)
    found = []
    for compiled in (False, "auto"):
        agent = make_agent(Deciding, **SMALL, compiled=compiled)
        agent.train(64)
        found.append(state(agent))
    torch.testing.assert_close(*found, rtol=0.0, atol=0.0)


IN_PLACE = "must not change its tensors in place, as it does"
BY_VALUES = "depends on the values of tensors, as an if does; write torch.where in place of it"
EVERY_MODE = tuple(MODES)
CASES: dict[str, tuple[type[Any], dict[str, Any], tuple[str, ...], str]] = {
    "a loss in place": (LossInPlace, {}, EVERY_MODE, f"a loss {IN_PLACE} 'advantages'; write x = x + y in place of"),
    "advantages in place": (AdvantagesInPlace, {}, EVERY_MODE, f"an advantage {IN_PLACE} 'rewards'; write x = x + y"),
    "a loss of PCN in place": (
        CommandsInPlace,
        {"env_id": SEA},
        ("eager", "compiled"),
        f"a loss {IN_PLACE} 'commands'",
    ),
    "a loss of values, compiled": (
        Deciding,
        {},
        ("compiled",),
        f"training.compiled = True: this update cannot be compiled; take false, or mend it: loss (own_algorithms.py, "
        f"line N) {BY_VALUES}",
    ),
    "a loss of values": (
        Deciding,
        {},
        EVERY_MODE[2:],
        f"loss (own_algorithms.py, line N) {BY_VALUES}, or train one seed at a time",
    ),
    "a network of values": (
        MOPPO,
        {"network": f"{HERE}:deciding_network"},
        EVERY_MODE[2:],
        f"forward (own_algorithms.py, line N) {BY_VALUES}, or train one seed at a time",
    ),
}


@pytest.mark.parametrize(("case", "mode"), [(case, mode) for case, (_, _, modes, _) in CASES.items() for mode in modes])
def test_what_is_not_a_pure_function_of_tensors_is_refused_in_the_first_update(
    case: str, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(algorithms.agent, "has_compiler", lambda _: True)
    cls, settings, _, message = CASES[case]
    size = {"hidden": [8, 8], "warmup_episodes": 4} if case.startswith("a loss of PCN") else SMALL
    agent = make_agent(cls, **size, **settings, **MODES[mode])
    with pytest.raises(ValueError, match=re.escape(message).replace("line\\ N", r"line\ \d+")) as refused:
        agent.train(10_000)
    assert agent.updates <= 2  # of PCN the first collects alone
    assert "\n" not in str(refused.value)


def test_a_utility_that_cannot_be_called_for_several_seeds_is_refused_before_training() -> None:
    make_agent(MOPPO, utility=deciding_utility, seed=3)
    with pytest.raises(
        ValueError,
        match=r"utility '.*deciding_utility' cannot be called by torch.func.vmap, as for .*"
        r"deciding_utility \(own_algorithms.py, line \d+\) depends on the values of tensors",
    ):
        make_agent(MOPPO, utility=deciding_utility, seed=[3, 4])


def test_compiling_without_a_compiler_is_refused_before_training_and_not_tried_by_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    monkeypatch.setitem(algorithms.agent.WORTHWHILE, "cpu", 0)
    agent = make_agent(MOPPO, **SMALL, compiled=True)
    with pytest.raises(
        ValueError, match=r"training.compiled = True needs a C\+\+ compiler such as g\+\+, which is not"
    ):
        agent.train(64)
    assert agent.step == 0
    agent = make_agent(MOPPO, **SMALL, compiled="auto")
    agent.train(64)
    assert agent.learners[0].compiled is False
