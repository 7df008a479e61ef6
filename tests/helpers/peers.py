"""Short tasks for peers, and adapters that need none of the libraries."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mo_gymnasium
import numpy as np

from algorithms.peers import PeerConfig, PeerTask
from algorithms.peers.peer_task import PeerPolicies, Recorder
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env

ONE_WAYPOINT = "mo-deepdrive-one-waypoint-v0"
FIXED = {"fixed_destination": True, "time_limit": 3.0}


def make_task(env_id: str = ONE_WAYPOINT, arguments: dict[str, Any] | None = None, **changes: Any) -> PeerTask:
    arguments = FIXED if arguments is None else arguments
    env = EnvAdapter(make_env(env_id, 2, arguments))
    task = PeerTask(
        make_single_env=lambda **more: mo_gymnasium.make(env_id, **arguments, **more),
        env=env,
        config=PeerConfig(),
        utility=None,
        steps=50,
        seed=5,
        device="cpu",
        reference_point=None,
        recorder=Recorder(env.objectives, None, 10, lambda step, metrics: None),
    )
    return replace(task, **changes)


def constant_policies(task: PeerTask, actions: list[int]) -> PeerPolicies:
    """One policy per action that always takes this action."""
    table = np.array(actions)
    return PeerPolicies(task, lambda rows, inputs: table[rows], table[:, None].astype(float), ("action",))


def fake_adapter(task: PeerTask, _algorithm: object) -> PeerPolicies:
    """An adapter that learns nothing: it takes some steps and returns three constant policies."""
    env = task.make()
    env.reset()
    for _ in range(task.steps):
        if any(env.step(7)[2:4]):
            env.reset()
    return constant_policies(task, [0, 2, 3])
