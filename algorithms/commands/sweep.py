"""Train all runs of a sweep: on this machine, on Ray or on Slurm; or only list them.

    mo-deepdrive sweep --config sweeps/one_waypoint             # on this machine, one run per core
    mo-deepdrive sweep --config FILE --on ray --address auto            # on a running Ray cluster
    mo-deepdrive sweep --config FILE --on slurm                         # as a Slurm job array
    mo-deepdrive sweep --config FILE --on slurm --dry-run               # print the Slurm batch script
    mo-deepdrive sweep --config FILE --on manifest                      # only write the list of runs
    mo-deepdrive sweep --output DIR --status                            # show the progress
    mo-deepdrive sweep --output DIR --verify                            # name finished runs whose files are broken
    mo-deepdrive sweep --config FILE --remake                           # make them again

Run the same command again to resume: finished runs are skipped, interrupted ones continue from their checkpoints. The
sweep's directory has manifest.jsonl, with one line per run, and the run directories; mo-deepdrive table and
mo-deepdrive plot read it.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from algorithms.runs.cli import PROCESS_DEFAULTS, check_directory, make_parser, warn
from algorithms.runs.interrupts import Stopped, no_space
from algorithms.studies import BACKENDS
from algorithms.studies.sweep_settings import load_sweep

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace, _MutuallyExclusiveGroup
    from collections.abc import Callable

    from rich.console import Console

    from algorithms.studies.backends import Backend
    from algorithms.studies.execution import Runner

ENVIRONMENT = {
    **PROCESS_DEFAULTS,
    "TUNE_DISABLE_SIGINT_HANDLER": "1",  # this command handles signals itself
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
    "RAY_NUM_REDIS_GET_RETRIES": "1",  # report an unreachable cluster within a minute
    "RAY_AIR_NEW_OUTPUT": "0",  # this command prints the progress, for all backends
}
REQUIRED_MODULES = {"ray": "ray", "slurm": "submitit"}
BACKENDS_OF_OPTIONS = {
    "workers": ("local", "ray"),
    "address": ("ray",),
    "dry_run": ("slurm",),
    "no_wait": ("slurm",),
    "remake": ("local", "ray", "slurm"),
}
WHILE_TRAINING = {"on": "local", "workers": None, "address": None, "no_wait": False}  # options, with their defaults


def parse_arguments(arguments: list[str]) -> Namespace:
    """The options."""
    parser = make_parser(__doc__, "sweep")
    parser.add_argument("--config", metavar="FILE", help="YAML file of the sweep, or the name of a shipped one")
    add_run_arguments(parser, "sweep")
    options = parser.parse_args(arguments)
    if options.config is None and not ((options.status or options.verify) and options.output):
        parser.error("--config is required, except for --status and --verify with --output")
    return options


def add_run_arguments(parser: ArgumentParser, what: str) -> _MutuallyExclusiveGroup:
    """The options of what trains many runs; returns those of which one alone can be given.

    Args:
        parser: which they are added to.
        what: is trained.
    """
    parser.add_argument("--on", choices=BACKENDS, default="local", help="where to train the runs (default: local)")
    folder = {"sweep": "sweeps", "study": "studies"}[what]
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help=f"the {what}'s directory (default: runs/{folder}/NAME)"
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help="maximum number of concurrent runs (default: limited by the cores)"
    )
    parser.add_argument(
        "--address", metavar="A", help="address of a running Ray cluster, or auto (default: start Ray here)"
    )
    parser.add_argument("--no-wait", action="store_true", help="Slurm: submit the jobs and exit")
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument("--dry-run", action="store_true", help="Slurm: print the batch script and write nothing")
    instead.add_argument("--status", action="store_true", help=f"show the progress of the {what} and exit")
    instead.add_argument(
        "--verify",
        action="store_true",
        help="compare the files of finished runs with their recorded hashes, name what is broken and exit",
    )
    instead.add_argument(
        "--remake", action="store_true", help="also make finished runs again whose files are broken, in their place"
    )
    return instead


def check_options(options: Namespace) -> None:
    """Check the options before any work."""
    if options.workers is not None and options.workers < 1:
        raise ValueError(f"--workers {options.workers} must be at least 1")
    check_directory("--output", options.output)
    for flag in (name for name in ("status", "verify", "tables") if getattr(options, name, False)):
        for name, default in WHILE_TRAINING.items():
            if getattr(options, name, None) not in (None, default):
                raise ValueError(f"--{name.replace('_', '-')} has no effect beside --{flag}, which trains nothing")
    for name, backends in BACKENDS_OF_OPTIONS.items():
        if getattr(options, name, False) and options.on not in backends:
            raise ValueError(f"--{name.replace('_', '-')} is for --on {' and '.join(backends)}, not {options.on}")
    module = REQUIRED_MODULES.get(options.on)
    if module is not None and find_spec(module) is None:
        raise ValueError(f"--on {options.on} needs {module}: pip install 'mo-deepdrive[sweep]'")


def run_command(options: Namespace, directory: Path, make: Callable[[Path, Backend, Console], Runner]) -> int:
    """Do what the options of :func:`add_run_arguments` say; returns the exit code.

    Args:
        options: the options.
        directory: of the runs.
        make: what makes the runner.
    """
    from algorithms.runs.console import make_console, print_line
    from algorithms.studies.backends import Backend
    from algorithms.studies.execution import progress, verify

    console = make_console()
    try:
        check_options(options)
        if options.status:
            print_line(console, progress(directory))
            return 0
        if options.verify:
            return 1 if verify(directory, lambda line: print_line(console, line)) else 0
        backend = Backend(options.on, options.workers, options.address, wait=not options.no_wait)
        runner = make(directory, backend, console)
        if options.remake:
            return runner.remake()
        return runner.print_batch_script() if options.dry_run else runner.run()
    except (ValueError, OSError) as error:
        warn(f"error: {error}")
        return 1 if isinstance(error, OSError) and no_space(error) else 2
    except Stopped as error:
        warn(f"error: {error}\nrun the same command again to resume")
        return 1


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments`` and return the exit code."""
    options = parse_arguments(arguments)

    def make(directory: Path, backend: Backend, console: Console) -> Runner:
        from algorithms.studies.sweep import SweepRunner

        return SweepRunner(load_sweep(options.config), directory, backend, console)

    directory = options.output or Path("runs") / "sweeps" / Path(options.config).stem
    return run_command(options, directory, make)
