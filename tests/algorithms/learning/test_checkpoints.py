"""Checkpoints of every kind of agent with one thing changed: refused in one line, or training continues."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from algorithms import A2C, MAPPO, MOA2C, MOCAC, MOPPO, PCN, PPO, ConditionedMOPPO, RulebookPPO
from algorithms.learning.checkpoints import write_checkpoint
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.support.faults import NotFinite
from tests.helpers.agents import CONTINUOUS, INTERSECTION, LEFT_TURN, ONE_WAYPOINT, SEA, make_agent, same

ONE_LINE = r"^[^\n]+$"
SHORT = {"time_limit": 0.3}

# Tampered numbers overflow where they are used.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


def small(cls: Any, env_id: str = ONE_WAYPOINT, **arguments: Any) -> Any:
    return make_agent(cls, env_id, num_envs=2, hidden=[4], steps=2, **arguments)


def small_pcn(env: dict[str, Any]) -> PCN:
    made = make_env(ONE_WAYPOINT, 2, {**SHORT, **env})
    return PCN(made, hidden=[4], batch_size=4, gradient_steps=1, warmup_episodes=4, buffer_size=4)


def small_conditioned() -> ConditionedMOPPO:
    made = make_env(ONE_WAYPOINT, 2, SHORT)
    families = {"families": {"chebyshev": 1.0, "comfort_budget": 1.0}, "budgets": {"jerk": 10.0}}
    return ConditionedMOPPO(made, hidden=[4], steps=2, minibatches=1, epochs=1, max_policies=4, **families)


KINDS: dict[str, Callable[[], Any]] = {
    "a2c": lambda: small(A2C, env=SHORT),
    "ppo": lambda: small(PPO, minibatches=1, epochs=1, env=SHORT),
    "mo_ppo": lambda: small(MOPPO, minibatches=1, epochs=1, env=SHORT),
    "rulebook_ppo": lambda: small(RulebookPPO, minibatches=1, epochs=1, env=SHORT),
    "mocac": lambda: small(MOCAC, env=SHORT),
    "mappo": lambda: small(MAPPO, INTERSECTION, minibatches=1, epochs=1, env=SHORT),
    "conditioned_mo_ppo": small_conditioned,
    "left turn": lambda: small(A2C, LEFT_TURN, env=SHORT),
    "mo_a2c, continuous": lambda: small(MOA2C, env={**SHORT, **CONTINUOUS}),
    "mo_ppo, two vehicles": lambda: small(MOPPO, INTERSECTION, minibatches=1, epochs=1, env=SHORT),
    "mo_a2c, another library": lambda: small(MOA2C, SEA),
    "pcn": lambda: small_pcn({}),
    "pcn, continuous": lambda: small_pcn(CONTINUOUS),
}


def train(agent: Any, updates: int = 1) -> None:
    """A few updates more, of which the last may be logged."""
    last = agent.updates + updates
    total = agent.step + 10**6 if updates > 1 else agent.step + 1
    agent.train(total, log=lambda step, metrics: None, log_interval=10**6, after_update=lambda a: a.updates >= last)


def contents(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    with safe_open(path, framework="pt") as file:
        return load_file(path), json.loads(file.metadata()["checkpoint"])


def write(path: Path, tensors: dict[str, torch.Tensor], identity: Any) -> Path:
    save_file(tensors, path, metadata={"checkpoint": json.dumps(identity)})
    return path


@pytest.fixture(scope="module", params=KINDS)
def saved(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """The kind of an agent, and its checkpoint after a few updates."""
    agent = KINDS[request.param]()
    train(agent, 5)
    path = tmp_path_factory.mktemp("saved") / "checkpoint.safetensors"
    agent.save(path)
    return request.param, path


def number(tensor: torch.Tensor, value: float) -> torch.Tensor:
    """``tensor`` with its last entry set to ``value``, or to the nearest that its type has."""
    changed = tensor.clone().reshape(-1).numpy().copy()
    if changed.dtype.kind in "iu":
        value = float(np.clip(np.nan_to_num(value), np.iinfo(changed.dtype).min, 2.0**62))
    with np.errstate(all="ignore"):
        changed[-1:] = np.array(value).astype(changed.dtype)
    return torch.from_numpy(changed).reshape(tensor.shape)


FORMS: dict[str, Callable[[torch.Tensor], torch.Tensor | None]] = {
    "missing": lambda tensor: None,
    "another type": lambda tensor: tensor.to(torch.float16 if tensor.dtype != torch.float16 else torch.float32),
    "another axis": lambda tensor: tensor[None].clone(),
    "empty": lambda tensor: torch.zeros(0, dtype=tensor.dtype),
    "one entry more": lambda tensor: torch.cat([tensor.reshape(-1), torch.zeros(1, dtype=tensor.dtype)]),
}


def representatives(tensors: dict[str, torch.Tensor]) -> list[str]:
    """One of the names that differ in their numbers alone."""
    found: dict[str, str] = {}
    for name in sorted(tensors):
        found.setdefault(re.sub(r"\d+", "#", name), name)
    return list(found.values())


def refused(agent: Any, path: Path, *parts: str) -> None:
    """Loading raises an error of one line with these parts, and leaves the agent as it was."""
    before = {name: tensor.clone() for name, tensor in agent.get_state().items()}
    for policy_only in (False, True):
        with pytest.raises(ValueError, match=ONE_LINE) as caught:
            agent.load(path, policy_only=policy_only)
        assert all(part in str(caught.value) for part in parts), str(caught.value)
    assert agent.step == 0
    assert same(agent.get_state(), before)


@pytest.mark.slow
def test_a_truncated_checkpoint_is_refused(saved: tuple[str, Path], tmp_path: Path) -> None:
    kind, path = saved
    agent, whole = KINDS[kind](), path.read_bytes()
    for kept in (0, 4, 8, 100, len(whole) // 3, len(whole) - 1):
        (tmp_path / "broken").write_bytes(whole[:kept])
        refused(agent, tmp_path / "broken", "broken cannot be read")


def test_an_odd_entry_of_the_identity_is_refused(saved: tuple[str, Path], tmp_path: Path) -> None:
    kind, path = saved
    agent, (tensors, identity) = KINDS[kind](), contents(path)
    for value in (None, 4, "4", [[4]], {"0": 4}):
        odd = write(tmp_path / "odd", tensors, {**identity, "hidden": value})
        refused(agent, odd, f"has hidden = {value!r}; this agent has [4]")


def test_a_number_that_is_not_finite_is_neither_read_nor_written(saved: tuple[str, Path], tmp_path: Path) -> None:
    kind, path = saved
    tensors, identity = contents(path)
    agent = KINDS[kind]()
    real = [name for name, tensor in tensors.items() if tensor.is_floating_point() and tensor.numel()]
    assert len(real) > 10
    for name in representatives({name: tensors[name] for name in real}):
        for value in (math.nan, math.inf):
            changed = {**tensors, name: number(tensors[name], value)}
            write(tmp_path / "changed", changed, identity)
            for policy_only in (False, True):  # a policy is not acted by if its critic has diverged
                with pytest.raises(ValueError, match=ONE_LINE) as caught:
                    agent.load(tmp_path / "changed", policy_only=policy_only)
                assert f"has {name!r} with {value}; every number must be finite" in str(caught.value)
            with pytest.raises(NotFinite, match=f"{name}' with {value}"):
                write_checkpoint(path, changed, identity)
    agent.load(path)


@pytest.mark.slow
def test_a_tensor_of_another_form_is_refused_in_one_line(saved: tuple[str, Path], tmp_path: Path) -> None:
    kind, path = saved
    tensors, identity = contents(path)
    agent = KINDS[kind]()
    fixed = {name: each for name, each in tensors.items() if not any(part in name for part in agent.varying_shapes)}
    for name in representatives(fixed):
        for what, change in FORMS.items():
            changed = change(tensors[name])
            if what == "empty" and not tensors[name].numel():
                continue
            rest = {key: tensor for key, tensor in tensors.items() if key != name}
            write(tmp_path / "changed", rest if changed is None else {**rest, name: changed}, identity)
            with pytest.raises(ValueError, match=ONE_LINE):
                agent.load(tmp_path / "changed")
            assert agent.step == 0, (name, what)


def test_an_unknown_tensor_is_refused_by_name(saved: tuple[str, Path], tmp_path: Path) -> None:
    kind, path = saved
    tensors, identity = contents(path)
    for name in ("extra", "vehicle_0.actor.extra", "network.extra", "collector.worlds.extra", "unlogged.extra"):
        changed = write(tmp_path / "changed", {**tensors, name: torch.zeros(3)}, identity)
        with pytest.raises(ValueError, match=ONE_LINE) as caught:
            KINDS[kind]().load(changed)
        assert name in str(caught.value) or "'extra'" in str(caught.value)
        # What acting does not need is not read.
        KINDS[kind]().load(changed, policy_only=True)
