"""The explorer's page through the command line, and at the end of a training."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from algorithms.runs.build import load_policy
from algorithms.runs.report import evaluate_front_policies
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.fronts.reference_fronts import reference_front, shipped
from tests.helpers.script_runs import SEA_FRONT, Call, refused

pytestmark = pytest.mark.slow


def data_of(path: Path) -> list[dict[str, Any]]:
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', path.read_text(encoding="utf-8"))
    return list(json.loads(data)["fronts"])


def returns_of(path: Path, episodes: int, seed: int) -> np.ndarray:
    """(K, E, d) returns of every policy of a run."""
    run = Run.open(path)
    evaluations = evaluate_front_policies(
        load_policy(run), Front.read(path), run.experiment, episodes=episodes, seed=seed
    )
    return np.stack([each.returns[:, 0] for each in evaluations])


def test_a_training_ends_with_the_page_of_its_front(finished_front: Path) -> None:
    (front,) = data_of(finished_front / "explore.html")
    assert front["title"] == str(finished_front)
    assert front["command"] == f"mo-deepdrive choose {finished_front} {{preference}}"
    assert np.array_equal(front["returns"][0]["episodes"], returns_of(finished_front, 1, 2_000_000))
    assert len(front["scenes"]) == 1
    assert len(front["scenes"][0]["drives"]) == len(Front.read(finished_front))


def test_the_page_has_the_episodes_of_the_command_that_it_names(
    call: Call, finished_front: Path, tmp_path: Path
) -> None:
    options = ["--episodes", 3, "--seed", 17, "--output", "page.html"]
    code, out, error = call("explore", finished_front, "one_waypoint_front-pcn-printed", *options)
    assert (code, out) == (0, "written: page.html\n"), error
    first, second = data_of(tmp_path / "page.html")
    words = f"mo-deepdrive choose {finished_front} {{preference}} --episodes 3 --seed 17"
    assert first["command"] == words
    assert np.array_equal(first["returns"][0]["episodes"], returns_of(finished_front, 3, 17))
    assert second["title"] == "one_waypoint_front-pcn-printed"
    known = [(each["gamma"], len(each["bestKnown"])) for each in second["returns"]]
    assert known == [(gamma, len(reference_front("one_waypoint", gamma=gamma))) for gamma in (1.0, 0.99)]
    assert call("explore", finished_front, "--split", "test", "--output", "page.html")[0] == 0
    assert data_of(tmp_path / "page.html")[0]["command"].endswith("{preference} --split test")


def test_a_best_known_front_is_shown_with_the_drives_of_its_actions(call: Call, tmp_path: Path) -> None:
    code, _, error = call("explore", "best-known/static_obstacle_discrete", "--output", "page.html")
    assert code == 0, error
    (front,) = data_of(tmp_path / "page.html")
    policies = shipped("static_obstacle", "discrete")
    undiscounted, discounted = (np.array(each["episodes"])[:, 0] for each in front["returns"])
    assert [objective["key"] for objective in front["objectives"]][-1] == "time"
    for returns, kind in ((undiscounted, "undiscounted"), (discounted, "discounted")):
        stored = [getattr(policies[k], kind) for k in front["numbers"]]
        np.testing.assert_allclose(returns[:, :-1], stored, rtol=1e-4, atol=1e-4)
    assert front["command"] == "mo_deepdrive.fronts.reference_fronts.shipped('static_obstacle', 'discrete')[{policy}]"
    assert front["budget"]["prices"] == {"collision": 10.0}
    (scene,) = front["scenes"]
    ends = np.array([drive["vehicles"][0]["end"] == "arrived" for drive in scene["drives"]])
    assert np.array_equal(ends, undiscounted[:, 1] == 1.0)
    assert len(scene["obstacles"]) == 1


def test_a_front_of_another_librarys_environment_has_no_drives(call: Call, tmp_path: Path) -> None:
    (tmp_path / "sea.yaml").write_text(SEA_FRONT)
    code, out, error = call("train", "--config", "sea.yaml", "--output", "run")
    assert code == 0, out + error
    assert "explorer: run/explore.html: open it in a browser" in out
    (front,) = data_of(tmp_path / "run" / "explore.html")
    assert front["scenes"] == []
    assert front["returns"][0]["bestKnown"] != []


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["nowhere", "--output", "page.html"], ["'nowhere' is not a run directory"]),
        (["best-known/one_waypoint", "--output", "page.html"], ["no best-known front", "one_waypoint_discrete"]),
        (["best-known/", "--output", "page.html"], ["no best-known front"]),
        (["one_waypoint_linear-ppo", "--output", "page.html"], ["learnt one policy, not a front"]),
        (["one_waypoint_front-pcn", "--output", "page.txt"], ["--output 'page.txt' must end in .html"]),
        (["one_waypoint_front-pcn", "--output", "no/page.html"], ["--output 'no/page.html'", "is not a directory"]),
        (["one_waypoint_front-pcn", "--output", "page.html", "--episodes", "0"], ["--episodes 0"]),
    ],
)
def test_what_cannot_be_shown_is_refused(call: Call, tmp_path: Path, arguments: list[str], messages: list[str]) -> None:
    refused(call("explore", *arguments), *messages)
    assert not (tmp_path / "page.html").exists()
