"""Action sequences of trained runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from algorithms.runs.build import build
from algorithms.runs.config import load_experiment
from scripts.bounds.front import record_run


def test_every_policy_of_a_front_acts_greedily_once_and_then_sampled(make_run: Callable[..., Path]) -> None:
    path = make_run("mo-deepdrive-static-obstacle-v0", algorithm="pcn", fixed_destination=True)
    agent = build(load_experiment(path / "config.yaml"), num_envs=1)
    agent.load(path / "checkpoint.safetensors", policy_only=True)
    policies = len(agent.conditions())
    greedy = record_run(str(path), "static_obstacle", "discrete", 0).sequences
    sampled = record_run(str(path), "static_obstacle", "discrete", 3).sequences
    assert len(greedy) == policies
    assert len(sampled) == 4 * policies
    for first, again in zip(greedy, sampled, strict=False):
        np.testing.assert_array_equal(first, again)
