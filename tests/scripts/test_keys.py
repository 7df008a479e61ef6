"""The keys of YAML files: each has a description, and types and defaults are those of the settings models."""

from __future__ import annotations

import re

import pytest
from pydantic import Field

from algorithms import ALGORITHMS
from algorithms.commands.keys import Key, differing_values, experiment_keys, model_keys
from algorithms.peers import PEERS
from algorithms.runs.config import load_experiment
from algorithms.studies.settings import Learner, Study, StudyTask, SweepSettings
from mo_deepdrive.world.config import Settings
from tests.helpers.script_runs import Call, refused


def test_without_options_the_keys_of_all_algorithms_and_of_sweeps_are_listed(call: Call) -> None:
    code, out, error = call("keys")
    assert (code, error) == (0, "")
    for name in ALGORITHMS:
        assert f"\nhyperparameters of {name}; equations: help('algorithms.{name}')\n" in out
    for line in (
        "environment.arguments.time_limit: float > 0, <= 3600, default 60.0",
        'algorithm.advantage: "utility_difference" or "as_printed" or "utility_gradient" or '
        '"expected_utility", default',
        "training.seed: int >= 0, < 2147483648, default 0",
        "search.trials: int >= 1, <= 1e+15, required",
    ):
        assert f"\n{line}\n    " in out
    assert max(map(len, out.splitlines())) <= 120


def test_a_file_is_listed_with_its_algorithm_and_what_it_sets(call: Call) -> None:
    code, out, error = call("keys", "--config", "one_waypoint/mo_ppo_nonlinear")
    assert (code, error) == (0, "")
    assert re.search(
        r"^algorithm.hidden: list of int >= 1, <= 16384, default \[64, 32\]; here \[128, 64\]$", out, re.MULTILINE
    )
    assert re.search(r"^algorithm.gamma: float >= 0, <= 1, default 0.99$", out, re.MULTILINE)
    assert out.count("hyperparameters of ") == 1
    assert "search.trials" not in out
    assert "algorithm.epochs" in call("keys", "--algorithm", "mo_ppo")[1]


def test_unknown_names_are_refused_with_the_option_and_the_nearest(call: Call) -> None:
    refused(call("keys", "--algorithm", "mo_ppoo"), "--algorithm = 'mo_ppoo' is unknown; did you mean 'mo_ppo'")
    refused(call("keys", "--config", "one_waypoint/mo_ppo_nonlin"), "mo_ppo_nonlinear")


@pytest.mark.parametrize("command", ["train", "peers"])
def test_the_help_of_training_says_how_to_list_the_keys(call: Call, command: str) -> None:
    code, out, _ = call(command, "--help")
    assert code == 0
    assert "mo-deepdrive keys lists them" in " ".join(out.split())
    assert len(out.splitlines()) < 40


# ------------------------------------------------------------------------------------------------------- what is listed


class Shared(Settings):
    """What several algorithms have in common."""

    gamma: float | None = Field(default=None, gt=0.0, le=1.0)
    """Discount of :func:`algorithms.evaluate`, which is ``g``
    in the equations; None for 1."""
    steps: int = 16
    """Steps of a rollout."""


class Own(Shared):
    """Hyperparameters of somebody's algorithm."""

    steps: int = 32
    low: int
    names: tuple[str, ...] = ("a",)
    rate: float = Field(default=0.5, description="described in the field.")


@pytest.mark.parametrize("algorithm", [*ALGORITHMS, *PEERS])
def test_every_key_of_an_experiment_has_a_description(algorithm: str) -> None:
    keys = experiment_keys(algorithm)
    assert [key.name for key in keys if not key.description] == []
    assert len({key.name for key in keys}) == len(keys)
    assert {"environment.arguments.time_limit", "algorithm.gamma", "logging.wandb.project"} <= {
        key.name for key in keys
    }


def test_every_key_of_sweeps_and_studies_has_a_description() -> None:
    for kind in (SweepSettings, Study, StudyTask, Learner):
        assert [key.name for key in model_keys(kind) if not key.description] == []
    keys = model_keys(SweepSettings)
    assert {"search.space.NAME.low", "resources.cpus", "slurm.runs_per_job"} <= {key.name for key in keys}


def test_own_settings_are_described_at_their_fields_and_those_of_their_bases() -> None:
    assert model_keys(Own, "algorithm.") == [
        Key(
            "algorithm.gamma",
            "float > 0, <= 1 or null",
            "null",
            "Discount of algorithms.evaluate, which is g in the equations; null for 1.",
        ),
        Key("algorithm.steps", "int", "32", "Steps of a rollout."),
        Key("algorithm.low", "int", "required", ""),
        Key("algorithm.names", "list of str", '["a"]', ""),
        Key("algorithm.rate", "float", "0.5", "described in the field."),
    ]
    assert model_keys(Own)[3].text() == 'names: list of str, default ["a"]', "no blank line where there is none"


def test_types_and_defaults_are_those_that_are_checked() -> None:
    keys = {key.name: key for key in experiment_keys("mo_ppo")}
    assert keys["training.total_timesteps"].text() == (
        "training.total_timesteps: int >= 1, <= 1e+15, required\n"
        "    Environment steps, summed over the parallel environments."
    )
    assert keys["environment.arguments.cost_sign"].type == '"maximise" or "paper"'
    assert (keys["logging.wandb"].type, keys["logging.wandb"].default) == ("section", "null")
    assert keys["algorithm.hidden"].default == "[64, 32]"
    assert "environment.arguments.scenario" not in keys  # the id chooses it
    assert not any(name.startswith("environment.arguments.") for name in _names("pcn", "deep-sea-treasure-v0"))


def _names(algorithm: str, env_id: str) -> list[str]:
    return [key.name for key in experiment_keys(algorithm, env_id)]


def test_the_values_of_a_file_are_those_that_differ_from_the_defaults() -> None:
    keys = experiment_keys("mo_ppo")
    experiment = load_experiment("one_waypoint/mo_ppo_nonlinear", ["--environment.arguments.time_limit=30"])
    found = differing_values(experiment.to_dict(), keys)
    assert found["environment.arguments.time_limit"] == "30.0"
    assert found["utility.name"] == '"one_waypoint_nonlinear"'
    assert "environment.arguments.lane_margin" not in found
    assert "evaluation.gamma" not in found
