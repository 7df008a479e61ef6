"""List the policies of the zoo, which are trained already, with their scores.

    mo-deepdrive zoo
    mo-deepdrive evaluate one_waypoint_nonlinear-mo_ppo --video drive.mp4

Their names can be given instead of a run: to evaluate, choose (fronts) and play.
"""

from __future__ import annotations

from algorithms.runs.cli import INSTALLED, exit_on_error, make_parser


def main(arguments: list[str], program: str = INSTALLED) -> int:
    """Run the command line ``arguments``; returns the exit code."""
    make_parser(__doc__, program, "zoo").parse_args(arguments)

    from algorithms.runs.console import make_console
    from algorithms.zoo.listing import zoo_table

    with exit_on_error(ValueError, OSError, program=program):
        table = zoo_table()
        make_console().print(table if table.row_count else "the zoo is empty")
    return 0
