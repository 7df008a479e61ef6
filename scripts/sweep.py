"""Make the runs of a sweep: on this machine, on Ray, on Slurm; or only write down which they are.

    python scripts/sweep.py --config configs/sweeps/one_waypoint.yaml                  # here, one run per core
    python scripts/sweep.py --config FILE --on ray --address auto                      # on a running Ray cluster
    python scripts/sweep.py --config FILE --on slurm                                   # as a job array
    python scripts/sweep.py --config FILE --on manifest                                # only the list of runs

The same command again leaves alone what is done and goes on with what is not. The sweep's directory holds
manifest.jsonl, with a line for each run, and the run directories; scripts/table.py and scripts/plot.py take it.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # videos are drawn in memory
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
os.environ.setdefault("TUNE_DISABLE_SIGINT_HANDLER", "1")  # this script saves and stops by itself
os.environ.setdefault("RAY_CHDIR_TO_TRIAL_DIR", "0")
os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "1")  # a cluster that does not answer is an error within a minute
os.environ.setdefault("RAY_AIR_NEW_OUTPUT", "0")  # what it prints, this script prints for every engine
sys.path.append(os.getcwd())  # where a user's own utility lives

from rich.console import Console

from algorithms.experiments.dashboard import Dashboard
from algorithms.experiments.interrupts import Interrupts, Stopped, no_space
from algorithms.experiments.jobs import Job
from algorithms.experiments.progress_bar import make_console
from algorithms.experiments.run_directory import read_status
from algorithms.experiments.worker_pool import perform_all
from algorithms.sweeps.manifest import Row, expand, is_sweep, read_manifest, write_manifest
from algorithms.sweeps.scores import read_scores
from algorithms.sweeps.settings import SweepSettings, load_sweep

ENGINES = ("local", "ray", "slurm", "manifest")
NEEDS = {"ray": "ray", "slurm": "submitit"}
ONLY_FOR = {"workers": ("local", "ray"), "address": ("ray",), "dry_run": ("slurm",), "no_wait": ("slurm",)}


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of this script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--config", required=True, metavar="FILE", help="the sweep")
    parser.add_argument("--on", choices=ENGINES, default="local", help="what makes the runs (default: local)")
    parser.add_argument("--output", type=Path, metavar="DIR", help="the sweep's directory (default: runs/sweeps/NAME)")
    parser.add_argument(
        "--workers", type=int, metavar="N", help="runs at a time (default: as many as there are cores for)"
    )
    parser.add_argument("--address", metavar="A", help="of a running Ray cluster, or auto (default: none is needed)")
    parser.add_argument("--dry-run", action="store_true", help="Slurm: print the batch script and write nothing")
    parser.add_argument("--no-wait", action="store_true", help="Slurm: submit and leave")
    parser.add_argument("--status", action="store_true", help="show how far the sweep is, and leave")
    return parser.parse_args(arguments)


def check(options: argparse.Namespace) -> None:
    """Refuse what cannot be meant, before any work.

    Raises:
        ValueError: naming the option.
    """
    if options.workers is not None and options.workers < 1:
        raise ValueError(f"--workers {options.workers} must be at least 1")
    for name, engines in ONLY_FOR.items():
        if getattr(options, name) and options.on not in engines:
            raise ValueError(f"--{name.replace('_', '-')} is for --on {' and '.join(engines)}, not {options.on}")
    module = NEEDS.get(options.on)
    if module is not None and find_spec(module) is None:
        raise ValueError(f"--on {options.on} needs {module}: pip install 'mo-deepdrive[sweep]'")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Sweep:
    """A sweep and its directory.

    Args:
        settings: what its file says.
        directory: where it is.
    """

    def __init__(self, settings: SweepSettings, directory: Path):
        self.settings = settings
        self.directory = directory
        self.failed: dict[Job, str] = {}

    def expand(self) -> list[Row]:
        """The runs as far as they are known."""
        search = self.settings.search
        scores: dict[str, float | None] = {}
        if search is not None and is_sweep(self.directory):
            rows = read_manifest(self.directory)
            scores |= read_scores([row.job(self.directory) for row in rows], search.metric)
            self._remember_failures(rows)
        scores |= {job.id: None for job in self.failed if job.id is not None}
        return expand(self.settings, scores)

    def _remember_failures(self, rows: Sequence[Row]) -> None:
        """A search that has gone on from a failed run stands by that: made now, it would have to begin again."""
        assert self.settings.search is not None
        batches = [(row.trial or 0) // self.settings.search.batch for row in rows]
        for row, batch in zip(rows, batches, strict=True):
            status = read_status(self.directory / row.directory)
            if batch < max(batches) and status.get("state") == "failed":
                self.failed.setdefault(row.job(self.directory), str(status.get("reason")))

    def make(self, options: argparse.Namespace, console: Console, interrupts: Interrupts) -> list[Job]:
        """Make the runs, batch after batch of a search; all of them, whatever became of them."""
        while True:
            rows = self.expand()
            self._tell_what_is_gone(rows, console)
            write_manifest(self.directory, rows)
            jobs = [row.job(self.directory) for row in rows]
            open_jobs = [job for job in jobs if job not in self.failed and not job.done]
            if not open_jobs:
                return jobs
            already = len(jobs) - len(open_jobs)
            say(console, f"{len(jobs)} runs, {already} of them done, in {self.directory}")
            with Dashboard(jobs, console, self.directory.name) as monitor:
                self.failed |= self._engine(options, jobs, monitor, interrupts)
            if interrupts.received is not None or options.no_wait or self.settings.search is None:
                return jobs

    def _tell_what_is_gone(self, rows: Sequence[Row], console: Console) -> None:
        """The file may have changed since the manifest was written."""
        before = {row.id for row in read_manifest(self.directory)} if is_sweep(self.directory) else set()
        gone = len(before - {row.id for row in rows})
        if gone:
            say(console, f"{gone} runs of an earlier manifest are not in the sweep any more; their directories stay")

    def _engine(
        self, options: argparse.Namespace, jobs: Sequence[Job], monitor: Dashboard, interrupts: Interrupts
    ) -> dict[Job, str]:
        wanted = [job for job in jobs if job not in self.failed]

        def stop() -> bool:
            return interrupts.received is not None

        settings = self.settings
        if options.on == "local":
            workers = options.workers or max(1, int(cores() / settings.resources.cpus))
            return perform_all(wanted, workers, monitor, retries=settings.retries, stop=stop)
        what = wanted, settings, self.directory, monitor
        if options.on == "ray":
            from algorithms.sweeps.ray_tune import make_on_ray

            return make_on_ray(*what, stop=stop, address=options.address, workers=options.workers)
        from algorithms.sweeps.slurm import make_on_slurm

        return make_on_slurm(*what, stop=stop, wait=not options.no_wait)


def say(console: Console, text: str) -> None:
    """Print a line as it is."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def report(jobs: Sequence[Job], failed: dict[Job, str], console: Console) -> None:
    """What became of the runs, and why those that failed did."""
    say(console, Dashboard(jobs, console).summary())
    for job, error in failed.items():
        say(console, f"FAILED {job.name}: {error}\n  {job.path}")


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = parse_arguments(arguments)
    console = make_console()
    directory = options.output or Path("runs") / "sweeps" / Path(options.config).stem
    try:
        check(options)
        sweep = Sweep(load_sweep(options.config), directory)
        if options.status:
            report([row.job(directory) for row in read_manifest(directory)], {}, console)
            return 0
        if options.dry_run:
            return dry_run(sweep)
        if options.on == "manifest":
            rows = sweep.expand()
            print(f"{write_manifest(directory, rows)}: {len(rows)} runs")
            return 0
        with Interrupts() as interrupts:
            jobs = sweep.make(options, console, interrupts)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1 if isinstance(error, OSError) and no_space(error) else 2
    except Stopped as error:
        print(f"error: {error}\nthe same command again goes on from there", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    report(jobs, sweep.failed, console)
    if interrupts.received is not None:
        print(f"interrupted; {after_interrupt(options.on, directory)}", file=sys.stderr)
        return 128 + interrupts.received
    return 1 if sweep.failed else 0


def dry_run(sweep: Sweep) -> int:
    """Print what would be given to sbatch; the exit code."""
    from algorithms.sweeps.slurm import script

    jobs = [row.job(sweep.directory) for row in sweep.expand()]
    missing = [job for job in jobs if not job.done]
    print(script(missing, sweep.settings, sweep.directory) if missing else "all runs are done")
    return 0


def after_interrupt(engine: str, directory: Path) -> str:
    """What the user may want to know."""
    if engine != "slurm":
        return "what was being trained is saved: the same command goes on"
    from algorithms.sweeps.slurm import Queue

    queue = Queue(directory)
    queue.look()
    return f"the jobs stay in Slurm's queue: the same command watches them, `{queue.cancel_command()}` cancels them"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
