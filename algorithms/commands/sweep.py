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
from typing import TYPE_CHECKING, TypeVar

from algorithms.runs.cli import (
    PROCESS_DEFAULTS,
    Command,
    Option,
    Options,
    check_at_least,
    check_directory,
    flag,
    one_of,
    option,
    warn,
)
from algorithms.runs.console import make_console, print_line
from algorithms.runs.interrupts import Stopped, no_space
from algorithms.studies import BACKENDS

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

    from algorithms.studies.execution import Runner
    from algorithms.studies.plan import Plan, SweepPlan

    P = TypeVar("P", bound=Plan)

ENVIRONMENT = {
    **PROCESS_DEFAULTS,
    "TUNE_DISABLE_SIGINT_HANDLER": "1",  # this command handles signals itself
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
    "RAY_NUM_REDIS_GET_RETRIES": "1",  # report an unreachable cluster within a minute
    "RAY_AIR_NEW_OUTPUT": "0",  # this command prints the progress, for all backends
}
BACKENDS_OF_OPTIONS = {
    "workers": ("local", "ray"),
    "address": ("ray",),
    "dry_run": ("slurm",),
    "no_wait": ("slurm",),
    "remake": ("local", "ray", "slurm"),
}
WHILE_TRAINING = {"on": "local", "workers": None, "address": None, "no_wait": False}  # options, with their defaults


def run_options(kind: str, folder: str, *instead: Option) -> tuple[Option, ...]:
    """The options of what trains many runs; ``instead`` are others of its own that do something else."""
    checks = "compare the files of finished runs with their recorded hashes, name what is broken and exit"
    return (
        option("--on", None, "where to train the runs (default: local)", choices=BACKENDS, default="local"),
        option("--output", "DIR", f"the {kind}'s directory (default: runs/{folder}/NAME)", type=Path),
        option("--workers", "N", "maximum number of concurrent runs (default: limited by the cores)", type=int),
        option("--address", "A", "address of a running Ray cluster, or auto (default: start Ray here)"),
        flag("--no-wait", "Slurm: submit the jobs and exit"),
        one_of(
            flag("--dry-run", "Slurm: print the batch script and write nothing"),
            flag("--status", f"show the progress of the {kind} and exit"),
            flag("--verify", checks),
            flag("--remake", "also make finished runs again whose files are broken, in their place"),
            *instead,
        ),
    )


def check_options(options: Options) -> None:
    """Check the options before any work."""
    check_at_least(options, 1, "workers")
    check_directory("--output", options.output)
    for given in (name for name in ("status", "verify", "tables") if getattr(options, name, False)):
        for name, default in WHILE_TRAINING.items():
            if getattr(options, name) != default:
                raise ValueError(f"--{name.replace('_', '-')} has no effect beside --{given}, which trains nothing")
    for name, backends in BACKENDS_OF_OPTIONS.items():
        if getattr(options, name) and options.on not in backends:
            raise ValueError(f"--{name.replace('_', '-')} is for --on {' and '.join(backends)}, not {options.on}")
    module = {"ray": "ray", "slurm": "submitit"}.get(options.on)
    if module is not None and find_spec(module) is None:
        raise ValueError(f"--on {options.on} needs {module}: pip install --editable '.[sweep]'")


def directory_of(options: Options, folder: str) -> Path:
    """The directory of the runs: --output, or that of the name of --config in ``runs/FOLDER``."""
    if options.config is None and not ((options.status or options.verify) and options.output):
        raise ValueError("--config is required, except for --status and --verify with --output")
    return options.output or Path("runs") / folder / Path(options.config).stem


def run_command(
    options: Options,
    directory: Path,
    make_plan: Callable[[], P],
    finish: Callable[[P, Runner, Path, Console], None] | None = None,
) -> int:
    """Do what the options of :func:`run_options` say, then (with --tables alone) ``finish``; returns the exit code."""
    from algorithms.studies.execution import Backend, Runner, progress, verify

    console = make_console()
    try:
        check_options(options)
        if options.status:
            print_line(console, progress(directory))
            return 0
        if options.verify:
            return 1 if verify(directory, lambda line: print_line(console, line)) else 0
        plan = make_plan()
        backend = Backend(options.on, options.workers, options.address, wait=not options.no_wait)
        runner = Runner(plan, directory, backend, console)
        if options.dry_run:
            return runner.print_batch_script()
        code = 0
        if not getattr(options, "tables", False):
            code = runner.remake() if options.remake else runner.run()
        if finish is not None and options.on != "manifest":
            finish(plan, runner, directory, console)
        return code
    except (ValueError, OSError) as error:
        warn(f"error: {error}")
        return 1 if isinstance(error, OSError) and no_space(error) else 2
    except Stopped as error:
        warn(f"error: {error}\nrun the same command again to resume")
        return 1


def train_sweep(options: Options) -> int:
    """Do what the options say; returns the exit code."""

    def make_plan() -> SweepPlan:
        from algorithms.studies.plan import SweepPlan
        from algorithms.studies.settings import load_sweep

        return SweepPlan(load_sweep(options.config))

    return run_command(options, directory_of(options, "sweeps"), make_plan)


CONFIG = option("--config", "FILE", "YAML file of the sweep, or the name of a shipped one")
main = Command("sweep", __doc__, (CONFIG, *run_options("sweep", "sweeps")), train_sweep)
