"""Policies of the zoo by name, in the library and in the scripts."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from algorithms import zoo
from algorithms.commands import play
from algorithms.runs.run_directory import Run
from algorithms.zoo.exporting import export
from tests.helpers.agents import INTERSECTION, SEA
from tests.helpers.script_runs import Call, refused
from tests.helpers.zoo import (
    EVERY_KIND,
    Trained,
    assert_same_episodes,
    contents,
    whole_agent,
)


def test_policies_are_found_by_name(trained: Trained, home: Path) -> None:
    assert zoo.names() == []
    for name in ("two-mo_ppo", "one-a2c"):
        export(trained("a2c"), name)
    for name in ("half", ".one-a2c.tmp", "__pycache__"):
        (home / name).mkdir()
        (home / name / "config.yaml").write_text("")
    (home / ".one-a2c.tmp" / "checkpoint.safetensors").write_text("")
    assert zoo.names() == ["one-a2c", "two-mo_ppo"]
    assert zoo.find("one-a2c") == home / "one-a2c"
    assert Run.open("one-a2c").path == home / "one-a2c"
    assert Run.open(Path("one-a2c")).experiment == trained("a2c").experiment


def test_a_run_directory_takes_precedence_over_a_policy_of_the_same_name(
    trained: Trained, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export(trained("a2c"), "mine")
    shutil.copytree(trained("mo_ppo").path, tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    assert Run.open("mine").path == Path("mine")
    assert Run.open("mine").experiment.algorithm.name == "mo_ppo"
    shutil.rmtree(tmp_path / "mine")
    (tmp_path / "mine").write_text("a file is not a run")
    assert Run.open("mine").path == home / "mine"


def test_an_unknown_name_is_refused_with_the_nearest_one(trained: Trained, home: Path, call: Call) -> None:
    refused(call("evaluate", "one_waypoint-a2c"), "'one_waypoint-a2c' is not a run directory, and the zoo is empty")
    export(trained("a2c"), "one_waypoint-a2c")
    export(trained("mo_ppo, two vehicles"), "intersection-mo_ppo")
    near = "the zoo has no policy 'one_waypont-a2c'; the nearest: one_waypoint-a2c, intersection-mo_ppo; "
    near += "mo-deepdrive zoo lists all"
    message = f"'one_waypont-a2c' is not a run directory, and {near}"
    refused(call("evaluate", "one_waypont-a2c"), message)
    refused(call("choose", "one_waypont-a2c", "--weights", "jerk=1"), message)
    refused(call("play", "--env", INTERSECTION, "--against", "one_waypont-a2c"), message)
    refused(call("train", "--resume", "one_waypont-a2c"), message)
    for name in ("", ".", "..", "../zoo/one_waypoint-a2c", "/"):
        with pytest.raises(ValueError, match="the zoo has no policy"):
            zoo.find(name)


def test_a_human_can_play_against_a_policy_by_name(trained: Trained, home: Path) -> None:
    run = trained("mo_ppo, two vehicles")
    export(run, "intersection-mo_ppo")
    before = contents(home)
    options = play.main.parse(["--env", INTERSECTION, "--against", "intersection-mo_ppo", "--vehicle", "1"])
    env, agent, seats = play.open_environment(options)
    assert seats == [1]
    assert env.config.time_limit == 3
    assert_same_episodes(whole_agent(run), agent, run.experiment)
    assert contents(home) == before


@pytest.mark.slow
@EVERY_KIND
def test_training_cannot_be_resumed_from_the_zoo(trained: Trained, home: Path, call: Call, kind: str) -> None:
    path = export(trained(kind), "policy")
    before = contents(home)
    for what in ("policy", path):
        refused(call("train", "--resume", what), "holds the policy alone", "cannot be resumed")
    assert contents(home) == before


def test_the_zoo_is_listed(trained: Trained, home: Path, call: Call) -> None:
    kinds = {"first": "mo_ppo, two vehicles", "second": "pcn", "third": "mo_a2c, another environment"}
    both = {"success": 0.25, "vehicle_0/utility_esr": 1.0, "total_utility_esr": 33.44}
    scores = {
        "first": {"greedy": {**both, "success": 0.0}, "stochastic": both},
        "second": {"front": {"cardinality": 12.0, "hypervolume": 3.0}},
        "third": {},
    }
    for name, kind in kinds.items():
        export(trained(kind), name, about={"scores": scores[name]})
    code, out, error = call("zoo")
    assert (code, error) == (0, "")
    rows = [line.split(maxsplit=1) for line in out.splitlines() if line.strip().startswith(tuple(kinds))]
    assert [(name, " ".join(rest.split())) for name, rest in rows] == [
        ("first", "intersection_linear 0 / 25 33.4 / 33.4"),
        ("second", "one_waypoint, a front 12 policies"),
        ("third", f"{SEA}, linear"),
    ]
    assert "Names end" not in out
    for name in ("third-printed", "third-together"):
        export(trained(kinds["third"]), name, about={"scores": {}})
    out = " ".join(call("zoo")[1].split())
    assert "Names end in -printed for the paper's hyperparameters, in -together where the first vehicle to end " in out
    assert "-solved" not in out
    assert "docs/" not in out, "which an installed package does not have"
    (home / "second" / "about.json").write_text("[]")
    refused(call("zoo"), str(home / "second" / "about.json"))
    (home / "first" / "config.yaml").write_text("algorithm: 3\n")
    refused(call("zoo"), str(home / "first" / "config.yaml"))
