"""Sequences of actions as short texts, and what they earn when they are replayed.

A policy of a best-known front is stored as its actions (:mod:`mo_deepdrive.fronts.reference_fronts`); its return
follows by replaying them.
"""

from __future__ import annotations

import re
import string
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.world.actions import CONTINUOUS, action_table
from mo_deepdrive.world.batch import WorldBatch

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from mo_deepdrive.world.config import EnvConfig

CONTINUOUS_UNIT = 1.0 / 1024.0  # resolution of a stored continuous action; exact in float32
_NO_BRAKE = -1024  # units
_CONTINUOUS_RUN = re.compile(r"(-?\d+),(-?\d+)(?:,(-?\d+))?(?:\*(\d+))?(?: |$)")
_DISCRETE_RUN = re.compile(r"([a-z])(\d+)?")


def encode(actions: NDArray[Any]) -> str:
    """Write a sequence of actions, (n,) discrete, or (n, 3) continuous in multiples of CONTINUOUS_UNIT, as text.

    It has runs of equal actions. Discrete: a letter (a for 0) and, if it is repeated, the number of times: "d12a".
    Continuous: steer, acceleration and, if used, brake, in multiples of CONTINUOUS_UNIT, and the number of times:
    "0,512*12 0,0,3".
    """
    rows = np.rint(actions / CONTINUOUS_UNIT).astype(np.int64) if actions.ndim == 2 else actions[:, None]
    starts = np.flatnonzero(np.r_[len(rows) > 0, (rows[1:] != rows[:-1]).any(axis=1)])
    counts = np.diff(np.r_[starts, len(rows)])
    runs = list(zip(rows[starts].tolist(), counts.tolist(), strict=True))
    if actions.ndim == 1:
        return "".join(string.ascii_lowercase[action] + (str(n) if n > 1 else "") for (action,), n in runs)
    written = (action if action[2] != _NO_BRAKE else action[:2] for action, _ in runs)
    return " ".join(
        ",".join(map(str, action)) + (f"*{n}" if n > 1 else "") for action, (_, n) in zip(written, runs, strict=True)
    )


def decode(text: str, action_type: str) -> NDArray[Any]:
    """The (n,) int64 discrete actions, or (n, 3) float64 continuous ones, that :func:`encode` wrote.

    Another text is a ValueError.
    """
    continuous = action_type == CONTINUOUS
    matches = list((_CONTINUOUS_RUN if continuous else _DISCRETE_RUN).finditer(text))
    if "".join(match[0] for match in matches) != text:
        raise ValueError(f"{text!r} is not a sequence of {action_type} actions")
    counts = [int(match.groups()[-1] or 1) for match in matches]
    if continuous:
        runs = [[match[1], match[2], match[3] or _NO_BRAKE] for match in matches]
        numbers = np.array(runs, dtype=np.float64).reshape(-1, 3)
        return np.repeat(numbers * CONTINUOUS_UNIT, counts, axis=0)
    letters = np.array([string.ascii_lowercase.index(match[1]) for match in matches], dtype=np.int64)
    if len(letters) and letters.max() >= len(action_table(action_type)):
        raise ValueError(f"{text!r} is not a sequence of {action_type} actions")
    return np.repeat(letters, counts)


def idle(action_type: str) -> NDArray[Any]:
    """The action that does nothing: no steering, no throttle, no brake."""
    return np.array([0.0, 0.0, -1.0]) if action_type == CONTINUOUS else np.array(0, dtype=np.int64)


def replay(config: EnvConfig, sequences: Iterable[NDArray[Any]]) -> NDArray[np.float32]:
    """Replay K sequences of actions, each in its own environment; after its last action a vehicle is idle.

    The environment has one vehicle and is the same in every episode, as of
    :func:`mo_deepdrive.fronts.reference_fronts.front_config`. Returns the rewards (K, decisions, d) of all objectives;
    zero after the end of an episode.
    """
    listed = list(sequences)
    batch = WorldBatch(config, len(listed))
    nothing = idle(config.action_type)
    actions = np.empty((config.max_decisions, len(listed), 1, *nothing.shape), nothing.dtype)
    actions[:] = nothing
    for row, sequence in enumerate(listed):
        actions[: len(sequence), row, 0] = sequence[: config.max_decisions]
    batch.place()
    rewards: list[NDArray[np.float32]] = []
    while not batch.over().all():
        batch.step(actions[len(rewards)])
        rewards.append(batch.rewards[:, 0].copy())
    return np.stack(rewards, axis=1)


def discounted_sum(rewards: NDArray[Any], gamma: float) -> NDArray[np.float64]:
    """Returns (K, d) of rewards (K, decisions, d), in double precision."""
    weights = gamma ** np.arange(rewards.shape[1], dtype=np.float64)
    return np.asarray(np.einsum("ktd,t->kd", rewards.astype(np.float64), weights))
