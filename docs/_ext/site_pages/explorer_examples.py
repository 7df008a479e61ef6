"""The explorer's pages: fronts of the zoo, and a best-known one."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

# The arguments of the command by the page that it writes; docs/explorer.md has the commands.
EXAMPLES: dict[str, tuple[str, ...]] = {
    "explore_one_waypoint.html": ("one_waypoint_front-pcn", "best-known/one_waypoint_discrete"),
    "explore_drawn_destinations.html": ("one_waypoint_drawn_front-conditioned_mo_ppo",),
    "explore_left_turn.html": ("left_turn_front-conditioned_mo_ppo", "--episodes", "100"),
}


def write_examples(folder: Path) -> None:
    """Write the pages that are absent, as the commands in docs/explorer.md do."""
    from algorithms.commands import explore

    for name, fronts in EXAMPLES.items():
        if not (folder / name).is_file():
            explore.main([*fronts, "--output", str(folder / name)])
