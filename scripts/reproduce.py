"""Make the paper's figures and claims again: train what is missing, judge, draw.

    python scripts/reproduce.py --all                 # everything, into docs/results, the README and the zoo
    python scripts/reproduce.py --figure 4            # what figure 4 shows
    python scripts/reproduce.py --claim 2 --seeds 3   # what claim 2 needs, with three seeds
    python scripts/reproduce.py --quick               # everything in minutes: fewer seeds, shorter training
    python scripts/reproduce.py --redraw              # from the results that are there, without training

Runs that are finished are kept, interrupted ones gone on with: the same command again does what is left.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")

from rich.console import Console

from algorithms.experiments.dashboard import Dashboard
from algorithms.experiments.interrupts import Interrupts, Stopped
from algorithms.experiments.progress_bar import make_console
from algorithms.experiments.run_directory import Run
from algorithms.experiments.worker_pool import perform_all
from algorithms.reproduction.claims import CLAIMS, utility_metric
from algorithms.reproduction.figures import FIGURES
from algorithms.reproduction.plan import Entry, Plan, entries, load_plan
from algorithms.reproduction.report import (
    FRONT_CELL,
    insert_verdicts,
    is_study,
    keep_fronts,
    median_entry,
    verdict_table,
    write_report,
)
from algorithms.reproduction.results import Results, gather
from algorithms.zoo.exporting import export

ROOT = Path(__file__).resolve().parent.parent
PUBLISHED = ROOT / "docs" / "results"


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of this script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--all", action="store_true", help="everything (also without --figure and --claim)")
    what.add_argument(
        "--figure", type=int, choices=FIGURES, metavar="N", help="what a figure of the paper shows: 4 to 10"
    )
    what.add_argument(
        "--claim", type=int, choices=[claim.number for claim in CLAIMS], metavar="N", help="what a claim needs: 1 to 6"
    )
    parser.add_argument("--seeds", type=int, metavar="N", help="runs of each setting (default: as the plan says)")
    parser.add_argument("--quick", action="store_true", help="fewer seeds and shorter training")
    parser.add_argument("--redraw", action="store_true", help="judge and draw the results in --output, train nothing")
    parser.add_argument("--runs", type=Path, metavar="DIR", help="run directories (default: runs/reproduce[-quick])")
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="where to write (default: docs/results for --all, else RUNS/results)"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count(), metavar="N", help="runs at a time")
    parser.add_argument("--plan", type=Path, default=ROOT / "configs" / "reproduce.yaml", metavar="FILE")
    return parser.parse_args(arguments)


def check(options: argparse.Namespace) -> None:
    """Refuse what cannot be meant, before any work.

    Raises:
        ValueError: naming the option.
    """
    for name in ("seeds", "workers"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ValueError(f"--{name} {value} must be at least 1")
    if options.redraw and (options.quick or options.seeds is not None):
        raise ValueError("--redraw trains nothing; it takes neither --quick nor --seeds")


def chosen(options: argparse.Namespace, plan: Plan) -> tuple[list[str], list[int]]:
    """The cells and figures that the options ask for."""
    if options.figure is not None:
        cells = {cell: None for claim in CLAIMS if options.figure in claim.figures for cell in claim.cells}
        return list(cells), [options.figure]
    if options.claim is not None:
        claim = next(claim for claim in CLAIMS if claim.number == options.claim)
        return list(claim.cells), list(claim.figures)
    return list(plan.cells), list(FIGURES)


def export_policies(wanted: Sequence[Entry], plan: Plan, results: Results) -> list[str]:
    """Put the run with the median score of every compared variant into the zoo; their names."""
    names = []
    for cell, arm, variant in dict.fromkeys((entry.cell, entry.arm, entry.variant) for entry in wanted):
        if is_study(plan.cells[cell].arms[arm]):
            continue
        front = cell == FRONT_CELL
        metric, policy = ("hypervolume", "front") if front else (utility_metric(cell), "stochastic")
        mine = [entry for entry in wanted if (entry.cell, entry.arm, entry.variant) == (cell, arm, variant)]
        entry = median_entry(mine, results, metric, policy)
        if entry is not None:
            suffix = "" if arm == "best" else f"-{arm}"
            names.append(f"{cell}-{entry.job.experiment.algorithm['name']}{suffix}")
            export(
                Run.open(entry.job.path),
                names[-1],
                about={"chosen": f"median {metric} of its seeds"},
            )
    return names


def reproduce(options: argparse.Namespace, plan: Plan, console: Console) -> int:
    """Train what is missing, then write; the exit code."""
    cells, figures = chosen(options, plan)
    everything = options.figure is None and options.claim is None
    runs = options.runs or Path("runs") / ("reproduce-quick" if options.quick else "reproduce")
    output = options.output or (PUBLISHED if everything and not options.quick else runs / "results")
    how = "python scripts/reproduce.py " + " ".join(_as_given(options))
    if options.redraw:
        results = Results.read(output)
        _write(plan, results, output, figures, how, console)
        return 0
    wanted = entries(plan, cells, runs, seeds=options.seeds, quick=options.quick, root=ROOT)
    missing = sum(not entry.job.done for entry in wanted)
    console.print(f"{len(wanted)} runs, {missing} of them to be made, {options.workers} at a time, in {runs}")
    jobs = [entry.job for entry in wanted]
    with Interrupts() as interrupts, Dashboard(jobs, console) as monitor:
        failed = perform_all(jobs, options.workers, monitor, stop=lambda: interrupts.received is not None)
    if interrupts.received is not None:
        print("interrupted; what was being trained is saved: the same command goes on", file=sys.stderr)
        return 128 + interrupts.received
    results = gather(wanted)
    if not results.scores:
        raise ValueError("no run has finished")
    output.mkdir(parents=True, exist_ok=True)
    keep_fronts(wanted, results, output)
    _write(plan, results, output, figures, how, console)
    if everything and options.output is None and not options.quick and options.seeds is None and not failed:
        insert_verdicts(ROOT / "README.md", plan, results)
        names = export_policies(wanted, plan, results)
        console.print(f"README.md has the verdicts; the zoo has {', '.join(names)}")
    for job, error in failed.items():
        console.print(f"FAILED {job.name}: {error}", markup=False, highlight=False, soft_wrap=True)
    return 1 if failed else 0


def _as_given(options: argparse.Namespace) -> list[str]:
    """The options that say what is made, as they would be typed."""
    given = ["--quick"] if options.quick else []
    for name in ("figure", "claim", "seeds"):
        value = getattr(options, name)
        given += [] if value is None else [f"--{name} {value}"]
    return given if options.figure or options.claim or options.quick else ["--all", *given]


def _write(plan: Plan, results: Results, output: Path, figures: Sequence[int], how: str, console: Console) -> None:
    paths = write_report(plan, results, output, figures, how=how)
    console.print(verdict_table(plan, results), markup=False, highlight=False, soft_wrap=True)
    console.print(f"written: {', '.join(str(path) for path in paths)}", soft_wrap=True)


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = parse_arguments(arguments)
    try:
        check(options)
        return reproduce(options, load_plan(options.plan), make_console())
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except Stopped as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
