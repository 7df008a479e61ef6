"""Train an agent with checkpoints, then evaluate it, plot its curves and record a video."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from algorithms.learning.checkpoints import read_checkpoint
from algorithms.reporting.fronts import FrontsFile
from algorithms.reporting.training_log import rows_until
from algorithms.runs.build import build_trainee
from algorithms.runs.config import Experiment, find_environment, make_experiment
from algorithms.runs.console import print_line
from algorithms.runs.interrupts import PATIENCE, Interrupts, describe, stopped_by
from algorithms.runs.loggers import Logger
from algorithms.runs.progress import ProgressReporter, compilation_noted
from algorithms.runs.report import (
    FRONT_EPISODES,
    distinct_episodes,
    evaluation_env,
    report_run,
    show_results,
    write_explorer,
)
from algorithms.runs.run_directory import FRONTS_FILE, METRICS_FILE, Run
from mo_deepdrive.evaluation.front import best_known_front
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.support.faults import Fault
from mo_deepdrive.world.config import is_ours

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

Watch = Callable[[int, Mapping[str, float]], None]
Stop = Callable[[], bool]


def resume(*runs: Run) -> Any:
    """The agent of runs whose locks are held, from their last checkpoints; untrained if there are none."""
    trainee = build_trainee([run.experiment for run in runs])
    checkpoints = [run.checkpoint for run in runs if run.checkpoint.exists()]
    if checkpoints and len(checkpoints) < len(runs):
        raise ValueError("some of the runs have a checkpoint and others have none; resume them apart")
    if checkpoints:
        trainee.load(*checkpoints)
    return trainee


def reopen(*paths: str, trust: bool = False, total_timesteps: Any = None) -> tuple[list[Run], Any]:
    """Open and lock existing runs, to resume them; the runs, and their agent or that of the first one on a CPU.

    Several may differ in their seeds alone. ``total_timesteps`` is a new, greater length of the training.
    """
    runs = [Run.open(path, trust=trust) for path in paths]
    longer = [] if total_timesteps is None else [_longer(run.experiment, total_timesteps) for run in runs]
    for run in runs:
        if run.checkpoint.exists():
            read_checkpoint(run.checkpoint, {}, whole=True)  # a policy of the zoo is refused before a lock is written
    for run in runs:
        run.lock()
    trainees = [resume(*runs)] * len(runs) if runs[0].experiment.is_resident else [resume(run) for run in runs]
    for run, agent in zip(runs, trainees, strict=True):
        for name in (METRICS_FILE, FRONTS_FILE):
            rows_until(run.path / name, agent.step)
    trainee = trainees[0]
    if longer:
        if trainee.schedules:
            raise ValueError(
                f"training.total_timesteps = {longer[0].training.total_timesteps}: the run cannot be trained longer, "
                f"since these settings depend on the length of the training: {', '.join(trainee.schedules)}"
            )
        for run, experiment in zip(runs, longer, strict=True):
            run.experiment = experiment
            # In this order: a process that is killed in between leaves a run that can be resumed.
            run.set_status("running", trainee.step)
            run.write_config()
    return runs, trainee


def _longer(experiment: Experiment, total_timesteps: Any) -> Experiment:
    """An experiment with a greater length of the training."""
    values = experiment.to_dict()
    values["training"]["total_timesteps"] = total_timesteps
    longer = make_experiment(values)
    if longer.training.total_timesteps <= (length := experiment.training.total_timesteps):
        raise ValueError(f"training.total_timesteps = {total_timesteps} must be more than the {length:,} of the run")
    return longer


def train_and_finish(
    runs: Run | Sequence[Run],
    trainee: Any,
    console: Console,
    *,
    resumed: bool = False,
    watch: Watch | None = None,
    stop: Stop | None = None,
) -> int | None:
    """Train runs to their end and :func:`finish` them, or train until SIGINT or SIGTERM; save in either case.

    After a signal the update, or the evaluation, goes on to its end and is saved if that takes no longer than PATIENCE
    and there is no second SIGINT; else the runs resume from their last checkpoints.

    Several runs are trained side by side by one ``trainee``, which is untrained or of :func:`resume`. ``watch`` is
    called with the step and the metrics of every logged row; ``stop`` after every update: True saves and stops as a
    signal does. After Stopped, where something could not be written, and Fault the last checkpoint is intact.

    Returns:
        The number of the signal that stopped training, 0 if ``stop`` did, or None if training is complete.
    """
    runs = [runs] if isinstance(runs, Run) else runs
    received = _train(runs, trainee, console, resumed, watch, stop)
    for seed, run in enumerate(runs) if received is None else ():
        if seed in trainee.failed:
            continue
        if len(runs) > 1:
            print_line(console, f"seed {run.experiment.training.seed}")
        try:
            finish(run, trainee.of_seed(seed), console)
        except Fault as error:
            if len(runs) == 1:
                raise
            trainee.fail(seed, error, "after the training")
            print_line(console, trainee.failed[seed])
    return received


class _Record:
    """What is written of a run while it trains: its rows, its checkpoints and its state."""

    logger: Logger
    fronts: FrontsFile | None = None

    def __init__(self, run: Run, saved: int):
        self.run, self.saved = run, saved  # the step of the last checkpoint

    def open(self, resumed: bool, say: Callable[[str], None]) -> Logger:
        """Open the files of rows, which are continued if the run was started before; the logger is to be closed."""
        run, after = self.run, (self.saved or -1) if resumed else None
        config = {**run.experiment.to_dict(), "versions": run.versions}
        self.logger = Logger(run.path, after=after, wandb=run.experiment.logging.wandb, config=config, say=say)
        if not run.experiment.known_utility:
            self.fronts = FrontsFile(run.path / FRONTS_FILE, after)
        run.set_status("running", self.saved)
        return self.logger

    def save(self, step: int, write: Callable[[Path], None], state: Any) -> None:
        """Have a checkpoint written, and note the state."""
        self.logger.sync()  # before the checkpoint, so that a crash cannot leave one without its rows
        if self.fronts is not None:
            self.fronts.sync()
        write(self.run.checkpoint)
        self.saved = step
        self.run.set_status(state, step)

    @property
    def rest(self) -> str:
        """What is left of a run that failed."""
        exists = self.run.checkpoint.exists()
        return f"the checkpoint of step {self.saved:,} is intact" if exists else "there is no checkpoint yet"


def _train(
    runs: Sequence[Run], trainee: Any, console: Console, resumed: bool, watch: Watch | None, stop: Stop | None
) -> int | None:
    """Train and save; arguments and result are those of :func:`train_and_finish`."""
    experiment = runs[0].experiment
    training, evaluation, logging = experiment.training, experiment.evaluation, experiment.logging
    checkpoint_interval = logging.checkpoint_interval or training.total_timesteps
    learns_front, episodes = not experiment.known_utility, evaluation.episodes
    if learns_front:
        episodes = distinct_episodes(experiment.environment, episodes)
    eval_env = evaluation_env(experiment, FRONT_EPISODES if learns_front else episodes)
    ours = is_ours(find_environment(experiment.environment.id))
    interrupts = Interrupts(PATIENCE)
    records = [_Record(run, trainee.step) for run in runs]
    ended: set[int] = set()  # seeds that failed while others go on
    progress = ProgressReporter(training.total_timesteps, trainee.step, console, arrivals=ours, front=learns_front)

    def log(record: _Record, step: int, metrics: Mapping[str, float]) -> None:
        record.logger.log(step, metrics)
        progress.note(metrics)
        if watch is not None:
            watch(step, metrics)

    def note_failures() -> None:
        for seed in trainee.failed.keys() - ended:
            ended.add(seed)
            runs[seed].end("failed", records[seed].saved, trainee.failed[seed])
            progress.say(f"{trainee.failed[seed]}; {records[seed].rest}")

    def save(state: Any) -> None:
        for seed, record in enumerate(records):
            if seed not in trainee.failed:
                with trainee.alone(seed, f"in the checkpoint of step {trainee.step:,}"):
                    record.save(trainee.step, partial(trainee.save, seed=seed), state)
        note_failures()

    def after_update(_: Any) -> bool:
        progress.update(trainee.step)
        note_failures()
        last_saved = max(record.saved for record in records)
        if trainee.step // checkpoint_interval > last_saved // checkpoint_interval:
            save("running")
        if interrupts.received is None and stop is not None and stop():
            interrupts.received = 0
        interrupts.settle()
        return interrupts.received is not None

    try:
        with interrupts, progress, compilation_noted(progress.say), contextlib.ExitStack() as loggers:
            for record in records:
                loggers.enter_context(record.open(resumed, progress.say))
            trainee.train(
                training.total_timesteps,
                eval_env,
                eval_interval=evaluation.interval,
                eval_episodes=episodes,
                eval_seed=SPLITS["validation"].start,
                eval_gamma=evaluation.gamma,
                reference_point=evaluation.reference_point,
                reference_front=best_known_front(eval_env, evaluation.gamma) if learns_front else None,
                log=[partial(log, record) for record in records],
                log_front=[record.fronts.write_front for record in records if record.fronts] or None,
                log_interval=logging.interval,
                after_update=after_update,
            )
            save("trained" if interrupts.received is None else "interrupted")
    except BaseException as error:
        interrupted = isinstance(error, KeyboardInterrupt) and interrupts.received
        for record in records:
            record.run.end(*("interrupted", record.saved) if interrupted else ("failed", record.saved, describe(error)))
        if isinstance(error, OSError):
            text = f"training stopped at step {trainee.step:,}: {error}; {records[-1].rest}"
            raise stopped_by(error, text) from error
        if not interrupted:
            raise
    finally:
        eval_env.close()
    return interrupts.received


def finish(run: Run, agent: Any, console: Console) -> None:
    """Evaluate the trained agent of a run, and report it; pictures that fail are printed, and cost no result."""
    settings, figures = run.experiment.evaluation, run.experiment.logging.save_figures
    try:
        report_run(run, agent, console)
        if settings.task is not None:
            from algorithms.runs.suite_entries import scorable, score_run  # not earlier: it imports scipy.stats

            score_run(run, scorable(agent, run.experiment))
        if figures and not run.experiment.known_utility:
            write_explorer(run, agent, console)
        show_results(run, agent.step, console)
        run.set_status("finished", agent.step)
    except OSError as error:
        raise stopped_by(error, f"the run is trained, but its results could not be written: {error}") from error
    except Fault as error:
        fault = type(error)(f"in the final evaluation: {error}")
        run.end("failed", agent.step, str(fault))
        raise fault from None
    except Exception as error:
        run.end("failed", agent.step, describe(error))
        raise
