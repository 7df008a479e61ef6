"""Checkpoints of every kind of agent with one thing changed: refused in one line, or training continues."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from algorithms import A2C, MAPPO, MOA2C, MOCAC, MOPPO, PCN, PPO, ConditionedMOPPO
from algorithms.learning.checkpoints import write_checkpoint
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.simulation.state import VEHICLE, with_room
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


def filled(tensor: torch.Tensor) -> torch.Tensor:
    """Bytes of 255."""
    raw = np.full(tensor.numel() * tensor.element_size(), 255, dtype=np.uint8)
    return torch.from_numpy(raw).view(tensor.dtype).reshape(tensor.shape)


VALUES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "huge": lambda tensor: number(tensor, 1e30),
    "a billion": lambda tensor: number(tensor, 1e9),
    "negative": lambda tensor: number(tensor, -1.0),
    "bytes of 255": filled,  # NaN, -1, 255, an invalid bool
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


@pytest.mark.slow
def test_a_tampered_tensor_is_refused_in_one_line_or_trains(saved: tuple[str, Path], tmp_path: Path) -> None:
    kind, path = saved
    tensors, identity = contents(path)
    outcomes: dict[tuple[str, str], str] = {}
    agent = KINDS[kind]()
    for name in representatives({name: tensor for name, tensor in tensors.items() if tensor.numel()}):
        for what, change in VALUES.items():
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
    assert "trains" in outcomes.values()
    agent.load(path)
    assert agent.step == identity["step"]


def test_a_number_that_is_not_finite_is_neither_read_nor_written(saved: tuple[str, Path], tmp_path: Path) -> None:
    kind, path = saved
    tensors, identity = contents(path)
    agent = KINDS[kind]()
    real = [name for name, tensor in tensors.items() if tensor.is_floating_point() and tensor.numel()]
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
    for name in representatives(tensors):
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


@pytest.fixture(scope="module")
def ppo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of PPO after a few updates."""
    agent = KINDS["ppo"]()
    train(agent, 3)
    path = tmp_path_factory.mktemp("ppo") / "checkpoint.safetensors"
    agent.save(path)
    return path


def refusal(path: Path, kind: str = "ppo") -> str:
    """The one-line message with which a new agent refuses a file, without the name of the file; it is unchanged."""
    agent = KINDS[kind]()
    before = {name: tensor.clone() for name, tensor in agent.get_state().items()}
    with pytest.raises(ValueError, match=ONE_LINE) as caught:
        agent.load(path)
    assert agent.step == 0
    assert same(agent.get_state(), before)
    return str(caught.value).removeprefix(f"checkpoint {path}").lstrip(": ")


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ("[]", "cannot be read: its identity is a list, not a mapping"),
        ('"ppo"', "cannot be read: its identity is a str, not a mapping"),
        ("null", "cannot be read: its identity is a NoneType, not a mapping"),
        ("[" * 100_000, "cannot be read: maximum recursion depth exceeded"),
        ("9" * 10_000, "cannot be read: Exceeds the limit"),
        ("{", "cannot be read: Expecting property name"),
    ],
)
def test_an_identity_that_is_no_mapping_is_refused(ppo: Path, tmp_path: Path, metadata: str, message: str) -> None:
    save_file(contents(ppo)[0], tmp_path / "odd", metadata={"checkpoint": metadata})
    assert refusal(tmp_path / "odd").startswith(message)


def test_a_pipe_or_a_folder_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for odd in (tmp_path / "pipe", tmp_path):
        assert refusal(odd) == "cannot be read: it is not a file"


@pytest.mark.parametrize("step", [-1, 1.5, "8", True, None, [8], 2**63, math.nan])
def test_a_number_of_steps_that_is_none_is_refused(ppo: Path, tmp_path: Path, step: Any) -> None:
    tensors, identity = contents(ppo)
    odd = write(tmp_path / "odd", tensors, {**identity, "step": step})
    assert refusal(odd) == f"has step = {step!r}; it must be an integer from 0 to {2**63 - 1}"
    with pytest.raises(ValueError, match="has step = "):
        KINDS["ppo"]().load(odd, policy_only=True)


@pytest.mark.parametrize("updates", [-1, 1.5, "8", None])
def test_a_number_of_updates_that_is_none_is_refused(ppo: Path, tmp_path: Path, updates: Any) -> None:
    tensors, identity = contents(ppo)
    odd = write(tmp_path / "odd", tensors, {**identity, "updates": updates})
    assert refusal(odd) == f"has updates = {updates!r}; it must be an integer from 0 to {2**63 - 1}"


@pytest.mark.parametrize("value", [None, 4, "4", [[4]], {"0": 4}])
def test_an_odd_entry_of_the_identity_is_refused(ppo: Path, tmp_path: Path, value: Any) -> None:
    tensors, identity = contents(ppo)
    odd = write(tmp_path / "odd", tensors, {**identity, "hidden": value})
    assert refusal(odd) == f"has hidden = {value!r}; this agent has [4]"


def worlds(tensors: dict[str, torch.Tensor], **fields: Any) -> dict[str, torch.Tensor]:
    """``tensors`` with other values in fields of the first world."""
    state = tensors["collector.worlds.state"].numpy().copy()
    for name, value in fields.items():
        state.view(with_room(VEHICLE, 0, 0, 0))[name][0] = value
    return {"collector.worlds.state": torch.from_numpy(state)}


def flags(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.uint8).view(torch.bool)


BROKEN: dict[str, tuple[str, Callable[[dict[str, torch.Tensor]], dict[str, torch.Tensor]], str]] = {
    "an index": (
        "ppo",
        lambda t: worlds(t, next_waypoint=10**9),
        "state has next_waypoint = 1000000000 for vehicle 0 of world 0; it must be between 0 and 0",
    ),
    "a position": (
        "ppo",
        lambda t: worlds(t, x=math.nan),
        "state has x = nan for vehicle 0 of world 0; it must be between -2000 and 2000",
    ),
    "a cursor": (
        "ppo",
        lambda t: {"collector.worlds.cursors": torch.tensor([0, 17])},
        "state 'cursors' has 17; it must be between 0 and 16",
    ),
    "worlds that wait": (
        "ppo",
        lambda t: {"collector.worlds.over": torch.tensor([False, True])},
        "step = 12, but environments have not been reset",
    ),
    "a beginning": (
        "ppo",
        lambda t: {"collector.worlds.begun": torch.tensor([False])},
        "step = 12, but environments have not been reset",
    ),
    "a bool": (
        "ppo",
        lambda t: {"collector.worlds.over": flags(0, 7)},
        "has 'collector.worlds.over' with 7 for a bool",
    ),
    "the generator of a world": (
        "ppo",
        lambda t: {"collector.worlds.generators": t["collector.worlds.generators"].clone().fill_(2)},
        "state 'generators' has the increment 2; it must be odd",
    ),
    "a discount": (
        "mo_ppo",
        lambda t: {"collector.discounts": torch.full((2, 1), 7.0)},
        "'collector.discounts' has 7; the environments' episodes allow ",
    ),
    "a length": (
        "mo_ppo",
        lambda t: {"collector.lengths": torch.tensor([[-3], [0]])},
        "'collector.lengths' has -3; the environments' episodes allow 0 to 0",
    ),
    "an accrued reward": (
        "mo_ppo",
        lambda t: {"collector.accrued": number(t["collector.accrued"], 1e9)},
        "'collector.accrued' has 1e+09; the environments' episodes allow ",
    ),
    "an observation": (
        "mo_ppo",
        lambda t: {"collector.observations": number(t["collector.observations"], 3)},
        "'collector.observations' has 3; the environments' episodes allow ",
    ),
    "a number of steps": (
        "mo_ppo, two vehicles",
        lambda t: {"vehicle_1.optimiser.step": torch.tensor(2.5)},
        "the optimiser's state has step = 2.5; it must be an integer from 0 on",
    ),
    "a mean square": (
        "a2c",
        lambda t: {"vehicle_0.optimiser.exp_avg_sq": number(t["vehicle_0.optimiser.exp_avg_sq"], -1)},
        "the optimiser's state has exp_avg_sq = -1.0; it must not be negative",
    ),
    "a running mean": (
        "mo_ppo",
        lambda t: {"vehicle_0.episodes": torch.tensor(-1)},
        "'episodes' = -1 of a running mean must not be negative",
    ),
    "a team": (
        "mappo",
        lambda t: {"team.ended": torch.ones(2, 2, dtype=torch.bool)},
        "the teams' running episodes are broken: nobody is under way",
    ),
    "a preference": (
        "conditioned_mo_ppo",
        lambda t: {"preferences": torch.full((2, 1, 7), 0.5)},
        "[0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5] is no preference; it must have one family, weights that sum to 1",
    ),
    "a moment": (
        "ppo",
        lambda t: {"vehicle_0.optimiser.exp_avg": torch.zeros(3)},
        "has 'vehicle_0.optimiser.exp_avg' of shape (3,); this agent needs ",
    ),
    "episodes": (
        "ppo",
        lambda t: {"episodes": torch.zeros(1, 3, dtype=torch.float64)},
        "has 'episodes' of shape (1, 3); this agent needs (1, 8)",
    ),
    "weights": (
        "mo_a2c, continuous",
        lambda t: {"vehicle_0.actor.log_std": torch.tensor([0.0, math.nan, 0.0])},
        "has 'vehicle_0.actor.log_std' with nan; every number must be finite",
    ),
    "no episodes": (
        "pcn",
        lambda t: {"store.lengths": torch.zeros(0, dtype=torch.int64)},
        "the episodes of the buffer have 12 decisions; their lengths do not add up to it",
    ),
    "a long episode": (
        "pcn",
        lambda t: {"store.lengths": number(t["store.lengths"], 4)},
        "the episodes of the buffer have 12 decisions; their lengths do not add up to it",
    ),
    "a negative length": (
        "pcn",
        lambda t: {"store.lengths": torch.tensor([-3, 9, 3, 3])},
        "the episodes of the buffer have 12 decisions; their lengths do not add up to it",
    ),
    "lengths that overflow": (
        "pcn",
        lambda t: {"store.lengths": torch.tensor([2**62, 2**62, 2**62, 2**62 + 12])},
        "the episodes of the buffer have 12 decisions; their lengths do not add up to it",
    ),
    "fewer returns": (
        "pcn",
        lambda t: {"store.returns": t["store.returns"][:-1].clone()},
        "the episodes of the buffer do not fit together: ",
    ),
    "infinite returns": (
        "pcn",
        lambda t: {"store.returns": number(t["store.returns"], math.inf)},
        "has 'store.returns' with inf; every number must be finite",
    ),
    "an action": (
        "pcn",
        lambda t: {"store.actions": number(t["store.actions"], 22)},
        "the buffer has actions that are not in [0, 22)",
    ),
    "a real action": (
        "pcn, continuous",
        lambda t: {"store.actions": number(t["store.actions"], math.nan)},
        "has 'store.actions' with nan; every number must be finite",
    ),
    "wide observations": (
        "pcn",
        lambda t: {"store.observations": torch.zeros(12, 16)},
        "the buffer has observations of torch.float32 and shape (16,); it needs torch.float32 and shape (15,)",
    ),
    "counts": (
        "pcn",
        lambda t: {"counts": torch.tensor([1, -4])},
        "counts = [1, -4] of updates and episodes must not be negative",
    ),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_value_is_refused_by_name(tmp_path: Path, what: str) -> None:
    kind, change, message = BROKEN[what]
    agent = KINDS[kind]()
    train(agent, 3)
    agent.save(tmp_path / "whole")
    tensors, identity = contents(tmp_path / "whole")
    broken = write(tmp_path / "broken", {**tensors, **change(tensors)}, identity)
    assert refusal(broken, kind).startswith(message)


def test_a_buffer_that_is_gone_is_refused(tmp_path: Path) -> None:
    agent = KINDS["pcn"]()
    agent.save(tmp_path / "fresh")
    KINDS["pcn"]().load(tmp_path / "fresh")
    train(agent)
    agent.save(tmp_path / "whole")
    tensors, identity = contents(tmp_path / "whole")
    kept = {name: tensor for name, tensor in tensors.items() if not name.startswith("store.")}
    message = f"the buffer is empty after {agent.step} steps and 4 episodes"
    assert refusal(write(tmp_path / "broken", kept, identity), "pcn") == message


def test_a_number_of_steps_that_no_update_ends_at_is_refused(ppo: Path, tmp_path: Path) -> None:
    tensors, identity = contents(ppo)
    odd = write(tmp_path / "odd", tensors, {**identity, "step": 13})
    assert refusal(odd) == "step = 13 must be the 4 steps of each of 3 updates"
