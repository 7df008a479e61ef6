"""The policies that the package ships."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from algorithms import zoo
from algorithms.runs.build import make_environment
from algorithms.runs.run_directory import Run
from algorithms.zoo.exporting import FILES
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.metrics import vehicle_prefix
from tests.helpers.zoo import (
    KILOBYTE,
    SHIPPED,
    policy_of,
)


def test_the_zoo_has_only_policies() -> None:
    folders = {path.name for path in SHIPPED.iterdir() if path.is_dir()} - {"__pycache__"}
    assert folders == {*zoo.names()}


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo.names())
def test_a_shipped_policy_loads_and_acts(name: str) -> None:
    path = zoo.find(name)
    assert {file.name for file in path.iterdir()} <= FILES
    assert sum(file.stat().st_size for file in path.iterdir()) < 200 * KILOBYTE
    about = json.loads((path / "about.json").read_text())
    run = Run.open(name)
    assert about["seed"] == run.experiment.training.seed
    assert about["step"] > 0
    assert re.fullmatch("[0-9a-f]{40}", about["commit"])
    assert run.experiment.training.device == "cpu"
    agent = policy_of(path)
    policy = agent
    if not run.experiment.known_utility:
        front = Front.read(path)
        prefixes = [vehicle_prefix(v, agent.env.vehicles) for v in range(agent.env.vehicles)]
        assert front.objectives == tuple(prefix + name for prefix in prefixes for name in agent.env.objectives)
        known = {tuple(row) for row in agent.conditions()}
        assert {tuple(row) for row in front.conditions.astype(np.float32)} <= known
        policy = agent.policy(front.conditions[-1])
    for greedy in (True, False):
        found = evaluate(policy, make_environment(run.experiment.environment, 1), episodes=1, seed=5, greedy=greedy)
        assert np.isfinite(found.returns).all()
        assert (found.lengths > 1).any()
    with pytest.raises(ValueError, match="holds the policy alone"):
        agent.load(run.checkpoint)
