"""Checkpoints of every kind of agent with one thing changed: refused in one line, or training continues."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from algorithms import A2C, MOA2C, MOPPO, PCN, PPO
from algorithms.common.env_adapter import make_env
from tests.helpers.agents import CONTINUOUS, INTERSECTION, ONE_WAYPOINT, SEA, make_agent

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

ONE_LINE = r"^[^\n]+$"
SHORT = {"time_limit": 0.3}

# Tampered numbers overflow where they are used.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


def small(cls: Any, env_id: str = ONE_WAYPOINT, **arguments: Any) -> Any:
    return make_agent(cls, env_id, num_envs=2, hidden=[4], steps=2, **arguments)


def small_pcn(env: dict[str, Any]) -> PCN:
    made = make_env(ONE_WAYPOINT, 2, {**SHORT, **env})
    return PCN(made, hidden=[4], batch_size=4, gradient_steps=1, warmup_episodes=4, buffer_size=4)


KINDS: dict[str, Callable[[], Any]] = {
    "a2c": lambda: small(A2C, env=SHORT),
    "ppo": lambda: small(PPO, minibatches=1, epochs=1, env=SHORT),
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


def filled(tensor: torch.Tensor) -> torch.Tensor:
    """Bytes of 255."""
    raw = np.full(tensor.numel() * tensor.element_size(), 255, dtype=np.uint8)
    return torch.from_numpy(raw).view(tensor.dtype).reshape(tensor.shape)


VALUES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "huge": lambda tensor: number(tensor, 1e30),
    "a billion": lambda tensor: number(tensor, 1e9),
    "negative": lambda tensor: number(tensor, -1.0),
    "very negative": lambda tensor: number(tensor, -1e30),
    "NaN": lambda tensor: number(tensor, np.nan),
    "infinite": lambda tensor: number(tensor, np.inf),
    "zeros": torch.zeros_like,
    "bytes of 255": filled,
}
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


def test_a_tampered_tensor_is_refused_in_one_line_or_trains(saved: tuple[str, Path], tmp_path: Path) -> None:
    kind, path = saved
    tensors, identity = contents(path)
    outcomes: dict[tuple[str, str], str] = {}
    for name in representatives({name: tensor for name, tensor in tensors.items() if tensor.numel()}):
        for what, change in VALUES.items():
            agent = KINDS[kind]()
            changed = write(tmp_path / "changed", {**tensors, name: change(tensors[name])}, identity)
            try:
                agent.load(changed)
                train(agent)
            except ValueError as error:
                message = str(error)
            else:
                message = "trains"
            outcomes[name, what] = message
    assert {case: message for case, message in outcomes.items() if len(message.splitlines()) != 1} == {}


def test_a_tensor_of_another_form_is_refused_in_one_line(saved: tuple[str, Path], tmp_path: Path) -> None:
    kind, path = saved
    tensors, identity = contents(path)
    agent = KINDS[kind]()
    for name in representatives(tensors):
        for what, change in FORMS.items():
            changed = change(tensors[name])
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
