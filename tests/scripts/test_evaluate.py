"""Evaluating runs and fronts through the command line."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from algorithms.runs.run_directory import changed_files
from mo_deepdrive.evaluation.front import Front
from tests.helpers.script_runs import PICTURES, Call, refused

pytestmark = pytest.mark.slow


def test_evaluate_prints_and_writes_its_numbers(finished: Path, tmp_path: Path, call: Call) -> None:
    options = ["--episodes", 5, "--seed", 9, "--video", "drive.mp4", "--stochastic", "--output", "numbers"]
    code, out, error = call("evaluate", finished, *options)
    assert code == 0, out + error
    for name in ("utility_esr", "success", "discounted_return/jerk", "mean_g_force", "greedy", "stochastic"):
        assert name in out
    assert (tmp_path / "drive.mp4").stat().st_size > 1000
    assert re.search(r"video: drive\.mp4: the stochastic policy from seed 9 on, [1-9]\d*\.\d s\n", out)
    assert "written: numbers\n" in out
    numbers = json.loads((tmp_path / "numbers" / "evaluation.json").read_text())
    assert (numbers["episodes"], numbers["seed"], numbers["step"]) == (5, 9, 2016)
    refused(call("evaluate", finished, "--episodes", 0), "--episodes 0")
    refused(call("evaluate", finished, "--video", "nowhere/drive.mp4"), "nowhere")
    refused(call("evaluate", finished, "--video", "drive.txt"), "--video 'drive.txt' must end in .mp4")
    assert not (tmp_path / "drive.txt").exists()


def test_evaluate_repeats_the_evaluation_at_the_end_of_training(finished: Path, tmp_path: Path, call: Call) -> None:
    code, out, error = call("evaluate", finished, "--output", "numbers")
    assert code == 0, out + error
    again = (tmp_path / "numbers" / "evaluation.json").read_text()
    assert again == (finished / "evaluation.json").read_text()


def test_evaluate_repeats_the_front_at_the_end_of_training(finished_front: Path, tmp_path: Path, call: Call) -> None:
    code, out, error = call("evaluate", finished_front, "--output", "numbers")
    assert code == 0, out + error
    for name in ("front.csv", "evaluation.json"):
        assert (tmp_path / "numbers" / name).read_bytes() == (finished_front / name).read_bytes(), name
    assert {path.name for path in (tmp_path / "numbers").iterdir()} == PICTURES | {"front.csv", "evaluation.json"}
    assert "hypervolume" in out
    for name in ("distance", "g_force", "jerk", "arrivals", "decisions"):
        assert name in out
    assert "destination" not in out, "arrivals say the same"


def test_evaluate_shows_a_front_on_other_episodes_and_films_it(
    finished_front: Path, tmp_path: Path, call: Call
) -> None:
    before = sorted((path.name, path.stat().st_mtime_ns) for path in finished_front.iterdir())
    options = ["--episodes", 3, "--seed", 9, "--video", "drive.mp4", "--output", "numbers"]
    code, out, error = call("evaluate", finished_front, *options)
    assert code == 0, out + error
    front = Front.read(tmp_path / "numbers")
    assert (front.episodes, front.seed) == (1, 9)
    assert "every episode is the same: 1 of 3 is driven" in out
    assert re.search(r"video: drive\.mp4: policies \d+(, \d+){0,3} of the front, seed 9, [1-9]\d*\.\d s\n", out)
    assert "written: numbers\n" in out
    np.testing.assert_array_equal(front.low, front.returns)  # every episode is the same
    assert (tmp_path / "drive.mp4").stat().st_size > 1000
    assert sorted((path.name, path.stat().st_mtime_ns) for path in finished_front.iterdir()) == before
    refused(call("evaluate", finished_front, "--episodes", 0), "--episodes 0")


def test_evaluate_renews_the_record_of_its_own_results(finished: Path, tmp_path: Path, call: Call) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    code, out, error = call("evaluate", run, "--episodes", 2, "--output", run)
    assert (code, error) == (0, ""), out + error
    assert (run / "evaluation.json").read_bytes() != (finished / "evaluation.json").read_bytes()
    assert changed_files(run) == []


def test_the_final_evaluation_is_not_replaced_by_one_of_other_scenarios(
    finished: Path, tmp_path: Path, call: Call
) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    before = (run / "evaluation.json").read_bytes()
    for options in (["--split", "validation"], ["--seed", 9]):
        refused(call("evaluate", run, *options, "--output", run), "would replace the final evaluation")
    assert (run / "evaluation.json").read_bytes() == before
    code, out, error = call("evaluate", run, "--output", run)
    assert code == 0, out + error
    assert (run / "evaluation.json").read_bytes() == before
