"""List the policies of the zoo, which are trained already, with their scores.

    mo-deepdrive zoo
    mo-deepdrive evaluate one_waypoint_nonlinear-mo_ppo --video drive.mp4

Their names can be given instead of a run: to evaluate, choose (fronts) and play.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.runs.cli import Command

if TYPE_CHECKING:
    from argparse import Namespace


def list_zoo(_options: Namespace) -> int:
    """Print the table of the policies."""
    from algorithms.runs.console import make_console
    from algorithms.zoo.listing import zoo_table

    make_console().print(zoo_table())
    return 0


main = Command("zoo", __doc__, (), list_zoo)
