"""From experiments to agents: what does not fit together is refused before training."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from algorithms.runs.build import build, training_memory
from algorithms.runs.config import make_experiment
from mo_deepdrive.support.machine import GIB
from tests.helpers.short_runs import VALUES


def experiment_with(**sections: Any) -> Any:
    return make_experiment({**VALUES, **sections})


TWO = {"id": "mo-deepdrive-intersection-v0"}
UTILITIES: dict[str, Any] = {
    "name": "intersection_linear",
    "vehicles": {"vehicle_1": {"name": "linear", "arguments": {"weights": [1, 0, 0, 0, 0, 0]}}},
}


def test_vehicles_have_their_own_utilities() -> None:
    agent = build(experiment_with(environment=TWO, utility=UTILITIES))
    assert [utility.name for utility in agent.utilities] == ["intersection_linear", "linear"]
    unknown = {**UTILITIES, "vehicles": {"vehicle_2": {"name": "linear"}}}
    with pytest.raises(ValueError, match=r"utility\.vehicles has 'vehicle_2'; did you mean 'vehicle_1'"):
        build(experiment_with(environment=TWO, utility=unknown))


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({}, "share_policy = True needs several vehicles that learn; mo-deepdrive-one-waypoint-v0 has one"),
        (
            {"environment": TWO, "utility": UTILITIES},
            "share_policy = True needs one utility for all vehicles, not 'intersection_linear', 'linear'",
        ),
        (
            {"algorithm": {"name": "pcn"}, "utility": None},
            "training.share_policy: algorithm 'pcn' cannot share a policy",
        ),
    ],
)
def test_a_policy_that_cannot_be_shared_is_refused(sections: dict[str, Any], message: str) -> None:
    training = {"total_timesteps": 96, "num_envs": 3, "share_policy": True}
    with pytest.raises(ValueError, match=re.escape(message)):
        build(experiment_with(training=training, **sections))


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return returns", r"gives shape \(4,\) for returns of shape \(4,\) as numpy, not \(\)"),
        ("raise RuntimeError('broken\\nagain')", r"fails on .* \(4,\) as numpy: RuntimeError: broken again$"),
        ("import numpy; return numpy.asarray(returns)[..., 0]", r"for returns of shape \(4,\) as torch, not numbers"),
        ("return returns.numpy()[..., 0]", "fails on returns .* as numpy: AttributeError"),
    ],
)
def test_a_users_utility_is_called_in_every_shape_before_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, message: str
) -> None:
    name = f"own_utility_{abs(hash(body))}"
    (tmp_path / f"{name}.py").write_text(f"def utility(returns):\n    {body}\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=message):
        build(experiment_with(utility={"name": f"{name}:utility"}))


@pytest.mark.parametrize("name", ["mo_a2c", "mo_ppo", "pcn", "conditioned_mo_ppo"])
def test_environments_that_do_not_fit_into_memory_are_refused_before_they_are_made(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    training = {"total_timesteps": 10**7, "num_envs": 1_000_000}
    values = {**VALUES, "algorithm": {"name": name}, "training": training}
    if name in ("pcn", "conditioned_mo_ppo"):
        del values["utility"]
    monkeypatch.setattr("mo_deepdrive.support.machine.available_memory", lambda: 2 * GIB)
    with pytest.raises(
        ValueError, match=r"^training\.num_envs = 1000000 takes at least [\d.]+ GiB of memory; 2\.0 GiB"
    ):
        build(make_experiment(values))
    few = make_experiment({**values, "training": {**training, "num_envs": 10_000}})
    assert training_memory(few, 10_000) < GIB
