"""The keys of YAML files are listed, each with a description."""

from __future__ import annotations

import re

import pytest

from algorithms import ALGORITHMS
from algorithms.commands.keys import experiment_keys, model_keys
from algorithms.peers import PEERS
from algorithms.studies.settings import Learner, Study, StudyTask, SweepSettings
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


# ------------------------------------------------------------------------------------------------------- what is listed


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
