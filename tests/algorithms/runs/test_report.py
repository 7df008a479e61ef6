"""Evaluations with the settings of an experiment: how many episodes are driven."""

from __future__ import annotations

from typing import Any

import pytest

from algorithms.runs.config import EnvironmentSettings
from algorithms.runs.report import distinct_episodes

OURS = "mo-deepdrive-{}-v0"


@pytest.mark.parametrize(
    ("scenario", "arguments", "same"),
    [
        ("one-waypoint", {"fixed_destination": True}, True),
        ("one-waypoint", {}, False),
        ("static-obstacle", {"fixed_destination": True, "fixed_obstacle": True}, True),
        ("static-obstacle", {"fixed_destination": True}, False),
        ("static-obstacle", {"fixed_obstacle": True}, False),
        ("intersection", {}, False),
    ],
)
def test_one_episode_is_driven_where_all_are_the_same(scenario: str, arguments: dict[str, Any], same: bool) -> None:
    settings = EnvironmentSettings(id=OURS.format(scenario), arguments=arguments)
    assert distinct_episodes(settings, 1000) == (1 if same else 1000)
