"""Train an agent from a YAML file, or resume a run that was interrupted.

    mo-deepdrive train --config configs/one_waypoint/mo_a2c_linear.yaml --seed 3
    mo-deepdrive train --config FILE --algorithm.learning_rate=3e-4 --training.total_timesteps=1e6
    mo-deepdrive train --resume runs/mo_a2c_linear/mo_a2c-seed3-20260101-120000
    mo-deepdrive train --resume RUN --training.total_timesteps=4e6

Every key of the YAML file is an option, --section.key=value; mo-deepdrive keys lists them. --seed and --device are
short for --training.seed and --training.device. The fourth line trains a run longer, which may be finished; it takes
one whose learning rate and other settings do not move with the training.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from algorithms.runs import cli
from algorithms.runs.config import load_experiment, parse_overrides
from algorithms.runs.run_directory import imported_paths, resume_options

if TYPE_CHECKING:
    from algorithms.runs.run_directory import Run


def open_runs(options: cli.Options) -> tuple[list[Run], Any]:
    """The new or resumed runs of the command line, one per seed, and what trains them."""
    from algorithms.runs.build import build_trainee
    from algorithms.runs.training import reopen
    from algorithms.studies.manifest import is_sweep

    if options.resume is None:
        if options.trust:
            raise ValueError("--trust is for --resume; --config is a file of yours, which may name code to import")
        experiment = load_experiment(options.config, options.overrides)
        experiments = experiment.of_seeds()
        side_by_side = experiment.is_resident or len(experiments) == 1
        trainee = build_trainee(experiments if side_by_side else experiments[:1])  # before a directory is created
        return cli.new_runs(options, experiments), trainee
    longer = dict(parse_overrides(options.overrides))
    total_timesteps = longer.pop("training.total_timesteps", None)
    if given := [*(f"--{key}" for key in longer), *(["--output"] if options.output else [])]:
        raise ValueError(
            "--resume continues the run with its own settings, apart from --training.total_timesteps; "
            f"it cannot take {' '.join(given)}"
        )
    for path in options.resume if total_timesteps is not None else ():
        if is_sweep(sweep := Path(path).resolve().parent.parent):
            raise ValueError(
                f"training.total_timesteps = {total_timesteps}: the run cannot be trained longer, since it is one of "
                f"the sweep {str(sweep)!r}; copy its directory to another place, and train that"
            )
    return reopen(*options.resume, trust=options.trust, total_timesteps=total_timesteps)


def next_steps(run: Run) -> str:
    """What to do with a finished run, in two lines."""
    path, trust = shlex.quote(str(run.path)), " --trust" if imported_paths(run.experiment.to_dict()) else ""
    shown = f"table {path}" if run.experiment.known_utility else f"explore {path}{trust}"
    line = f"mo-deepdrive evaluate {path} --video drive.mp4{trust}; mo-deepdrive plot {path}; mo-deepdrive {shown}"
    return f"next: {line}\n      tensorboard --logdir {path}"


def train(options: cli.Options) -> int:
    """Train, and evaluate what was trained."""
    with cli.exit_on_error(ValueError, OSError):
        runs, trainee = open_runs(options)
    if all(run.status.get("state") == "finished" for run in runs):
        print("\n".join(f"{run.path} is finished; there is nothing to resume" for run in runs))
        return 0

    from algorithms.runs.console import make_console
    from algorithms.runs.training import train_and_finish

    how = resume_options([run.path for run in runs], runs[0].experiment.to_dict())
    resume_with = f"resume with: mo-deepdrive train {how}"
    with cli.exit_on_error(hint=resume_with):
        for change in runs[0].changed_versions():
            cli.warn(f"warning: since the run was started, {change}")
        for run in runs:
            print(f"run {run.path}", flush=True)
        if len(runs) > 1 and not runs[0].experiment.is_resident:
            from algorithms.runs.jobs import train_apart

            received = train_apart(runs, make_console())
            if received == cli.FAILED:
                return cli.FAILED
        else:
            received = train_and_finish(runs, trainee, make_console(), resumed=options.resume is not None)
        if received is not None:
            print(f"interrupted at step {runs[0].status.get('step', 0):,}; {resume_with}")
            return 128 + received
    done = [run for seed, run in enumerate(runs) if seed not in trainee.failed]
    for run in done:
        print(f"finished: {run.path}")
    print(next_steps(done[0]))
    return 0 if len(done) == len(runs) else cli.FAILED


RESUME = cli.many("--resume", "RUN", "directory of a run to resume; of several, to go on side by side")
main = cli.Command(
    "train",
    __doc__,
    (cli.one_of(cli.CONFIG, RESUME, required=True), cli.RUN_OUTPUT, cli.TRUST),
    train,
    takes_keys=True,
    errors_of_input=(),  # in training they are errors of the program
)
