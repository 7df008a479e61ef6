"""The keys of YAML files, through the command line."""

from __future__ import annotations

import re

import pytest

from algorithms.runs.registry import algorithm_names
from tests.helpers.script_runs import Call, refused


def test_without_options_the_keys_of_all_algorithms_and_of_sweeps_are_listed(call: Call) -> None:
    code, out, error = call("keys")
    assert (code, error) == (0, "")
    for name in algorithm_names():
        assert f"\nhyperparameters of {name}; equations: help('algorithms.{name}')\n" in out
    for line in (
        "environment.arguments.time_limit: float > 0, <= 3600, default 60.0",
        'algorithm.advantage: "utility_difference" or "as_printed" or "utility_gradient" or '
        '"expected_utility", default',
        "training.seed: int >= 0, < 2147483648, default 0",
        "search.trials: int >= 1, required",
    ):
        assert f"\n{line}\n    " in out
    assert max(map(len, out.splitlines())) <= 120


def test_a_file_is_listed_with_its_algorithm_and_what_it_sets(call: Call) -> None:
    code, out, error = call("keys", "--config", "one_waypoint/mo_ppo_nonlinear")
    assert (code, error) == (0, "")
    assert re.search(r"^algorithm.hidden: list of int, default \[64, 32\]; here \[128, 64\]$", out, re.MULTILINE)
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
