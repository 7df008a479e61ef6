"""Exported policies: they act bit for bit like the checkpoints that they are from, and broken ones are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.torch import load_file

from algorithms import zoo
from algorithms.runs.build import make_environment
from algorithms.runs.run_directory import Run, versions
from algorithms.zoo.exporting import export
from tests.helpers.agents import same
from tests.helpers.zoo import (
    CONDITIONED,
    EVERY_ACTOR_CRITIC,
    EVERY_FRONT,
    EVERY_KIND,
    FRONTS,
    Trained,
    assert_same_episodes,
    policy_of,
    whole_agent,
)


def is_pcn(kind: str) -> bool:
    """Whether a kind of run has best episodes as part of its policy."""
    return kind.startswith("pcn")


@pytest.mark.slow
@EVERY_ACTOR_CRITIC
def test_an_exported_policy_acts_bit_for_bit_like_the_complete_checkpoint(
    trained: Trained, kind: str, tmp_path: Path
) -> None:
    run = trained(kind)
    path = export(run, "policy", tmp_path)
    assert_same_episodes(whole_agent(run), policy_of(path), run.experiment)


@pytest.mark.slow
@EVERY_FRONT
def test_an_exported_front_equals_that_of_the_complete_checkpoint_bit_for_bit(
    trained: Trained, kind: str, tmp_path: Path
) -> None:
    run = trained(kind)
    path = export(run, "policy", tmp_path)
    whole, alone = whole_agent(run), policy_of(path)
    first, second = whole.conditions(), alone.conditions()
    assert first.dtype == second.dtype
    assert first.tobytes() == second.tobytes()
    settings: dict[str, Any] = {"episodes": 2, "seed": 4, "gamma": 0.99}
    fronts = [each.front(make_environment(run.experiment.environment, 5), **settings) for each in (whole, alone)]
    for name in ("returns", "discounted", "conditions", "length", "success"):
        np.testing.assert_array_equal(getattr(fronts[0], name), getattr(fronts[1], name), err_msg=name)
    assert len(first) > 1
    for condition in first:
        assert_same_episodes(*(each.policy(condition) for each in (whole, alone)), run.experiment)
    assert (path / "front.csv").read_bytes() == (run.path / "front.csv").read_bytes()


@pytest.mark.slow
@EVERY_KIND
def test_only_what_is_needed_to_act_is_written_and_read(trained: Trained, kind: str, tmp_path: Path) -> None:
    run = trained(kind)
    policy = export(run, "policy", tmp_path) / zoo.CHECKPOINT
    allowed = ("bounds", "network.", "attained.") if is_pcn(kind) else ("vehicle_0.actor.", "vehicle_1.actor.", "ideal")
    tensors, whole = load_file(policy), load_file(run.checkpoint)
    assert all(name.startswith(allowed) for name in tensors)
    assert same(
        {name: tensor for name, tensor in tensors.items() if not name.startswith("attained.")},
        {name: tensor for name, tensor in whole.items() if name.startswith(allowed)},
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mo_ppo, centralised critic", "pcn", CONDITIONED])
def test_a_folder_describes_the_origin_of_its_policy(trained: Trained, kind: str, tmp_path: Path) -> None:
    run = trained(kind)
    path = export(run, "policy", tmp_path, {"chosen": "best of five seeds"})
    front = {"front.csv", "evaluation.json"} if kind in FRONTS else set()
    assert {file.name for file in path.iterdir()} == {"config.yaml", "checkpoint.safetensors", "about.json", *front}
    assert Run.open(path).experiment == run.experiment
    about = json.loads((path / "about.json").read_text())
    step = whole_agent(run).step
    assert step >= 256
    made_with = {name: versions()[name] for name in ("commit", "python", "packages")}
    assert about == {"seed": 3, "step": step, **made_with, "chosen": "best of five seeds"}
    with safe_open(path / zoo.CHECKPOINT, framework="pt") as file:
        stated = json.loads(file.metadata()["checkpoint"])
    assert (stated["policy_only"], stated["step"]) == (True, step)


def test_a_policy_trained_on_another_device_is_exported_for_the_cpu(trained: Trained, tmp_path: Path) -> None:
    run = trained("a2c")
    training = run.experiment.training.model_copy(update={"device": "cuda:99"})
    elsewhere = Run(run.path, run.experiment.model_copy(update={"training": training}))
    assert Run.open(export(elsewhere, "policy", tmp_path)).experiment.training.device == "cpu"
