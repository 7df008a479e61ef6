"""The script that makes the GIF of the README."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from tests.helpers.script_runs import Call, refused

CONDITIONED = "one_waypoint_drawn_front-conditioned_mo_ppo"

pytestmark = pytest.mark.slow


def test_a_policy_of_the_zoo_and_a_rule_side_by_side(call: Call, tmp_path: Path) -> None:
    path = tmp_path / "two.gif"
    names = ["one_waypoint_linear-ppo", "rule:hurried", "--frames", "40"]
    code, _, error = call("gif", *names, "--output", path, "--side", "48", "--seed", "7")
    assert code == 0, error
    with Image.open(path) as image:
        assert image.n_frames > 30
        assert image.size[0] == 2 * 48 + 4


def test_a_policy_under_two_preferences_in_one_scenario_with_its_returns(call: Call, tmp_path: Path) -> None:
    path = tmp_path / "preferences.gif"
    preferences = ["--preference", "in a hurry", "destination=5", "--preference", "wants comfort", "jerk=5"]
    code, _, error = call("gif", CONDITIONED, *preferences, "--output", path, "--side", "64")
    assert code == 0, error
    with Image.open(path) as image:
        width, height = image.size
        assert image.n_frames > 20
    assert width == 2 * 64 + 4
    assert height > 64 + 4 * 25  # the map, and a bar for every objective


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([CONDITIONED, "--preference", "hurried", "timm=5"], "unknown objective 'timm'"),
        (["one_waypoint_linear-ppo", "--preference", "hurried"], "has no preferences"),
        ([CONDITIONED, CONDITIONED, "--preference", "hurried"], "--preference needs one RUN"),
        (["one_waypoint_linear-pop"], "one_waypoint_linear-ppo"),
        (["one_waypoint_front-pcn"], "is a front of policies"),
        (["one_waypoint_linear-ppo", "--seed", "-1"], "--seed -1 must be between"),
        (["one_waypoint_linear-ppo", "--frames", "0"], "--frames 0 must be at least 1"),
        (["one_waypoint_linear-ppo", "--side", "3"], "--side 3 must be at least 16"),
    ],
)
def test_what_cannot_be_shown_is_refused(arguments: list[str], message: str, call: Call, tmp_path: Path) -> None:
    refused(call("gif", *arguments, "--output", tmp_path / "none.gif"), message)
    assert not list(tmp_path.iterdir())
