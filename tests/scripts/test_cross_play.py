"""scripts/cross_play.py writes its table and picture, and says what is wrong."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from algorithms import zoo
from algorithms.runs.build import build
from algorithms.runs.config import make_experiment
from algorithms.runs.run_directory import Run
from tests.helpers.script_runs import Call, refused

PAIR = "intersection_nonlinear-mo_ppo"
ROUNDABOUT = "mo-deepdrive-roundabout-v0"
ONE_ROLE = "intersection_linear-mo_ppo-strangers_0"  # learnt to drive vehicle 0


@pytest.mark.slow
def test_every_driver_meets_every_driver_of_the_other_vehicle(call: Call, tmp_path: Path) -> None:
    rules = ["--vehicle-0", "rule:gap_8", "--vehicle-1", "rule:straight_3", "rule:straight_6"]
    options = ["--episodes", "20", "--split", "validation", "--output", str(tmp_path / "made")]
    # Of a run in a folder the name is what is beyond the folder that all runs are in.
    code, out, error = call("cross_play", zoo.find(PAIR), ONE_ROLE, *rules, *options)
    assert code == 0, error
    with (tmp_path / "made" / "cross_play.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    straight = [PAIR, "rule:straight_3", "rule:straight_6"]
    assert [(row["vehicle_0"], row["vehicle_1"]) for row in rows] == [
        (a, b) for a in (PAIR, ONE_ROLE, "rule:gap_8") for b in straight
    ]
    assert all(float(row["success/low"]) <= float(row["success"]) <= float(row["success/high"]) for row in rows)
    # A pair that trained together arrives, and fails with a driver who is slower than any that it met.
    assert float(rows[0]["success"]) >= 0.95
    assert float(rows[1]["success"]) < 0.6
    assert min(float(row["success"]) for row in rows[3:]) >= 0.9
    assert (tmp_path / "made" / "cross_play.png").read_bytes().startswith(b"\x89PNG")
    assert "vehicle_0 with those that it met: 20 episodes" in out
    (tmp_path / "made" / "cross_play.png").unlink()
    assert call("cross_play", "--draw", tmp_path / "made")[0] == 0
    assert (tmp_path / "made" / "cross_play.png").is_file()
    assert "written" in out


@pytest.mark.slow
def test_drivers_of_several_preferences_meet_in_a_roundabout(call: Call, tmp_path: Path) -> None:
    experiment = make_experiment(
        {
            "environment": {"id": ROUNDABOUT, "arguments": {"vehicles": 3}},
            "algorithm": {"name": "conditioned_mo_ppo", "steps": 8, "hidden": [8], "minibatches": 1},
            "training": {"total_timesteps": 64, "num_envs": 4},
        }
    )
    run = Run.create(experiment, tmp_path / "run")
    agent = build(experiment)
    agent.train(64)
    agent.save(run.checkpoint)
    run.unlock()
    matrix = ["--env", ROUNDABOUT, "--vehicles", "3", "--preference", "hurried", "time=5", "--preference", "careful"]
    options = ["--episodes", "4", "--output", str(tmp_path / "made"), "--show", "vehicle_0/utility_esr"]
    code, out, error = call("cross_play", run.path, *matrix, *options, "--utility", "own")
    assert code == 0, error
    assert "among careful" in out
    with (tmp_path / "made" / "cross_play.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["vehicle_0"], row["others"]) for row in rows] == [
        (one, other) for one in ("hurried", "careful") for other in ("hurried", "careful")
    ]
    # Each is judged by its own weights, in units of the scales of the run.
    returns = np.array([[float(row[f"vehicle_0/return/{name}"]) for name in agent.env.objectives] for row in rows])
    weights = np.ones((4, returns.shape[1]))
    weights[:2, agent.env.objectives.index("time")] = 5.0
    expected = (returns * weights / agent.scales).sum(axis=1) / weights.sum(axis=1)
    np.testing.assert_allclose([float(row["vehicle_0/utility_esr"]) for row in rows], expected, rtol=1e-3)
    with_a_rule = [str(run.path), *matrix, "--others", "rule:balanced", *options[:3], str(tmp_path), "--utility", "own"]
    refused(call("cross_play", *with_a_rule), "--utility own: 'rule:balanced' has no preference")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "mo-deepdrive-left-turn-v0"], "has one vehicle; cross-play needs several"),
        (["--env", ROUNDABOUT, "--vehicle-0", "rule:careful", "--others", "rule:gap_3"], "no scripted driver"),
        (["--env", ROUNDABOUT, "--vehicle-0", "rule:careful"], "others has no driver"),
        (["nobody"], "'nobody' is not a run directory"),
        (["one_waypoint_linear-ppo"], "'one_waypoint_linear-ppo' cannot drive vehicle_0"),
        ([PAIR, PAIR], f"vehicle_0 has two drivers '{PAIR}'; the second is '{PAIR}'"),
        ([PAIR, "--vehicle-1", "rule:gap_3"], "'rule:gap_3' drives vehicle_0, not vehicle_1"),
        ([PAIR, "--utility", "intersection_linaer", "--episodes", "1"], "intersection_linear"),
    ],
)
def test_mistakes_are_errors_of_one_line(call: Call, tmp_path: Path, arguments: list[str], message: str) -> None:
    done = call("cross_play", *arguments, "--output", tmp_path / "made")
    refused(done, message)
    assert done[2].count("\n") == 1
    assert not (tmp_path / "made").exists()
