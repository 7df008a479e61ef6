"""The explorer's page of OneWaypoint: a front of the zoo, and the best-known one."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

EXAMPLE = "explore_one_waypoint.html"
FRONTS = ("one_waypoint_front-pcn", "best-known/one_waypoint_discrete")


def write_example(path: Path) -> None:
    """Write the page as the command in docs/explorer.md does."""
    from algorithms.commands import explore

    explore.main([*FRONTS, "--output", str(path)])
