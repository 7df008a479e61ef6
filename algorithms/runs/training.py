"""Train an agent with checkpoints, then evaluate it, plot its curves and record a video."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from algorithms.learning.checkpoints import read_checkpoint
from algorithms.reporting.fronts import FrontsFile
from algorithms.reporting.training_log import rows_until
from algorithms.runs.accessories import Accessory
from algorithms.runs.agent_report import VIDEO_FILE, report_agent, show_results
from algorithms.runs.config import Experiment, check_loggers, find_environment, is_ours, make_experiment
from algorithms.runs.console import print_line
from algorithms.runs.interrupts import PATIENCE, Interrupts, Moved, stopped_by
from algorithms.runs.loggers import Logger
from algorithms.runs.policy_evaluation import FRONT_EPISODES, distinct_episodes, evaluation_env
from algorithms.runs.progress_bar import ProgressReporter, compilation_noted
from algorithms.runs.run_directory import FRONTS_FILE, METRICS_FILE, Run
from algorithms.runs.side_by_side import build_trainee
from mo_deepdrive.evaluation.front import best_known_front
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.support.faults import Fault
from mo_deepdrive.support.yaml import dump

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from algorithms.agent import Log
    from mo_deepdrive.evaluation.front import Front

Watch = Callable[[int, Mapping[str, float]], None]


def resume(*runs: Run) -> Any:
    """What trains runs whose locks are held, from their last checkpoints; untrained if there are none.

    Returns:
        The agent of the runs.

    Raises:
        ValueError: if it cannot be built or loaded, or the runs cannot be trained side by side.
    """
    trainee = build_trainee([run.experiment for run in runs])
    checkpoints = [run.checkpoint for run in runs if run.checkpoint.exists()]
    if checkpoints and len(checkpoints) < len(runs):
        raise ValueError("some of the runs have a checkpoint and others have none; resume them apart")
    if checkpoints:
        trainee.load(*checkpoints)
    return trainee


def reopen(*paths: str, trust: bool = False, total_timesteps: Any = None) -> tuple[list[Run], Any]:
    """Open and lock existing runs, to resume them; the runs, and their agent or that of the first one on a CPU.

    Args:
        *paths: the runs' directories; several only of runs that differ in their seeds alone.
        trust: allow a config.yaml that names code to import.
        total_timesteps: a new, greater length of the training; None for that of the runs.

    Raises:
        ValueError: if there is no run, another process trains in it, its config.yaml is not trusted, its checkpoint or
            its metrics cannot be resumed from, it cannot be trained longer, or runs cannot be trained side by side.
        OSError: if a directory cannot be written.
    """
    runs = [Run.open(path, trust=trust) for path in paths]
    longer = [_longer(run.experiment, total_timesteps) for run in runs]
    for run in runs:
        check_loggers(run.experiment)
        if run.checkpoint.exists():
            read_checkpoint(run.checkpoint, {}, whole=True)  # a policy of the zoo is refused before a lock is written
    for run in runs:
        run.lock()
    side_by_side = runs[0].experiment.is_resident
    trainees = [resume(*runs)] * len(runs) if side_by_side else [resume(run) for run in runs]
    trainee = trainees[0]
    for run, each in zip(runs, trainees, strict=True):
        for name in (METRICS_FILE, FRONTS_FILE):
            rows_until(run.path / name, each.step)
    if total_timesteps is not None and trainee.schedules:
        for run in runs:
            run.unlock()
        raise ValueError(
            f"training.total_timesteps = {longer[0].training.total_timesteps}: the run cannot be trained longer, "
            f"since these settings depend on the length of the training: {', '.join(trainee.schedules)}"
        )
    for run, experiment in zip(runs, longer, strict=True):
        if experiment is not run.experiment:
            run.experiment = experiment
            # In this order: a process that is killed in between leaves a run that can be resumed.
            run.set_status("running", trainee.step)
            atomic_write(run.path / "config.yaml", dump(experiment.to_dict()).encode())
    return runs, trainee


def _longer(experiment: Experiment, total_timesteps: Any) -> Experiment:
    """An experiment with another length of the training; itself if that is None."""
    if total_timesteps is None:
        return experiment
    values = experiment.to_dict()
    values["training"]["total_timesteps"] = total_timesteps
    longer = make_experiment(values)
    length = experiment.training.total_timesteps
    if longer.training.total_timesteps <= length:
        raise ValueError(f"training.total_timesteps = {total_timesteps} must be more than the {length:,} of the run")
    return longer


def train_and_finish(
    runs: Run | Sequence[Run],
    trainee: Any,
    console: Console,
    *,
    resumed: bool = False,
    watch: Watch | None = None,
    stop: Callable[[], bool] | None = None,
) -> int | None:
    """Call :func:`train` and, unless it was stopped, :func:`finish`; arguments, result and errors are theirs."""
    runs = [runs] if isinstance(runs, Run) else runs
    received = train(runs, trainee, console, resumed=resumed, watch=watch, stop=stop)
    if received is None:
        for seed, run in enumerate(runs):
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
    """What is written of a run while it trains: its rows, its checkpoints and its state.

    Args:
        run: whose directory receives them.
        step: of the last checkpoint.
        logger: of its metrics.
        fronts: the file of its fronts; None where none is learnt.
    """

    def __init__(self, run: Run, step: int, logger: Logger, fronts: FrontsFile | None):
        self.run, self.saved, self.logger, self.fronts = run, step, logger, fronts

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Write a row of metrics."""
        self.run.check_place()
        self.logger.log(step, metrics)

    def log_front(self, step: int, front: Front) -> None:
        """Write a front."""
        self.run.check_place()
        assert self.fronts is not None
        self.fronts.write_front(step, front)

    def save(self, step: int, write: Callable[[Path], None], state: Any) -> None:
        """Have a checkpoint written, and note the state."""
        self.run.check_place()
        # In this order, so that a crash cannot leave a checkpoint without its rows or their note.
        fronts = {} if self.fronts is None else {FRONTS_FILE: self.fronts.sync()}
        self.run.note_rows(step, {METRICS_FILE: self.logger.sync(), **fronts})
        self.run.set_status("running", self.saved)
        write(self.run.checkpoint)
        self.saved = step
        self.run.set_status(state, step)


def train(
    runs: Sequence[Run],
    trainee: Any,
    console: Console,
    *,
    resumed: bool = False,
    watch: Watch | None = None,
    stop: Callable[[], bool] | None = None,
) -> int | None:
    """Train to the end of the runs' experiment, or until SIGINT or SIGTERM, and save in either case.

    Stopping and resuming do not affect what is learnt: checkpoints and evaluations depend on the step alone. After a
    signal the update, or the evaluation, goes on to its end and is saved if that takes no longer than PATIENCE and
    there is no second SIGINT; else the runs resume from their last checkpoints.

    Args:
        runs: their directories receive everything that is written; several if they are trained side by side.
        trainee: of :func:`build_trainee` or :func:`resume`, for these runs.
        console: for the progress.
        resumed: whether the runs were started before, so that their metrics are continued.
        watch: called with the step and the metrics of every logged row.
        stop: called after every update; True saves and stops as a signal does.

    Returns:
        The number of the signal that stopped training, 0 if ``stop`` did, or None if training is complete.

    Raises:
        Stopped: if something could not be written; the last checkpoint is intact.
        Fault: if something is not finite, or an episode does not end; the last checkpoint is intact.
    """
    experiment = runs[0].experiment
    training, evaluation, logging = experiment.training, experiment.evaluation, experiment.logging
    checkpoint_interval = logging.checkpoint_interval or training.total_timesteps
    begun = trainee.step
    known_utility = experiment.known_utility
    episodes = evaluation.episodes
    if not known_utility:
        episodes = distinct_episodes(experiment.environment, episodes)
    eval_env = evaluation_env(experiment, episodes if known_utility else FRONT_EPISODES)
    reference_front = None if known_utility else best_known_front(eval_env, evaluation.gamma)
    ours = is_ours(find_environment(experiment.environment.id))
    interrupts = Interrupts(PATIENCE)
    records: list[_Record] = []
    ended: set[int] = set()  # seeds that failed while others go on
    try:
        with (
            interrupts,
            ProgressReporter(
                training.total_timesteps, begun, console, arrivals=ours, front=not known_utility
            ) as reporter,
            compilation_noted(reporter.say),
            contextlib.ExitStack() as loggers,
        ):
            for run in runs:
                records.append(_open_record(run, begun, resumed, reporter.say, loggers))

            def log_of(record: _Record) -> Log:
                def log(step: int, metrics: Mapping[str, float]) -> None:
                    record.log(step, metrics)
                    reporter.note(metrics)
                    if watch is not None:
                        watch(step, metrics)

                return log

            def note_failures() -> None:
                for seed in trainee.failed.keys() - ended:
                    ended.add(seed)
                    _set_failed([runs[seed]], records, begun, trainee.failed[seed])
                    reporter.say(f"{trainee.failed[seed]}; {_last_checkpoint(runs[seed], records[seed].saved)}")

            def save(state: Any) -> None:
                for seed, record in enumerate(records):
                    if seed not in trainee.failed:
                        try:
                            record.save(trainee.step, partial(trainee.save, seed=seed), state)
                        except Fault as error:
                            trainee.fail(seed, error, f"in the checkpoint of step {trainee.step:,}")
                note_failures()

            def after_update(_: Any) -> bool:
                reporter.update(trainee.step)
                note_failures()
                last_saved = max(record.saved for record in records)
                if trainee.step // checkpoint_interval > last_saved // checkpoint_interval:
                    save("running")
                if interrupts.received is None and stop is not None and stop():
                    interrupts.received = 0
                interrupts.settle()
                return interrupts.received is not None

            for run in runs:
                run.set_status("running", begun)
            logs = [log_of(record) for record in records]
            log_fronts = None if known_utility else [record.log_front for record in records]
            trainee.train(
                training.total_timesteps,
                eval_env,
                eval_interval=evaluation.interval,
                eval_episodes=episodes,
                eval_seed=SPLITS["validation"].start,
                eval_gamma=evaluation.gamma,
                reference_point=evaluation.reference_point,
                reference_front=reference_front,
                log=logs,
                log_front=log_fronts,
                log_interval=logging.interval,
                after_update=after_update,
            )
            save("trained" if interrupts.received is None else "interrupted")
    except (OSError, Moved) as error:
        saved = [record.saved for record in records] or [begun]
        try:
            for run in runs:
                run.check_place()
        except Moved as moved:
            text = f"training stopped at step {trainee.step:,}: {moved}; resume it from where it is now"
            raise Moved(text) from None
        if isinstance(error, Moved):
            raise
        _set_failed(runs, records, begun, str(error))
        rest = _last_checkpoint(runs[-1], min(saved))
        raise stopped_by(error, f"training stopped at step {trainee.step:,}: {error}; {rest}") from error
    except Fault as error:
        _set_failed(runs, records, begun, str(error))
        raise
    except KeyboardInterrupt as error:
        if not interrupts.received:
            _set_failed(runs, records, begun, f"{type(error).__name__}: {error}")
            raise
        _set_state(runs, records, begun, "interrupted")
    except BaseException as error:
        _set_failed(runs, records, begun, f"{type(error).__name__}: {error}")
        raise
    finally:
        eval_env.close()
    return interrupts.received


def _open_record(
    run: Run, step: int, resumed: bool, say: Callable[[str], None], loggers: contextlib.ExitStack
) -> _Record:
    """Open what is written of a run that begins, or is continued, at a step."""
    experiment = run.experiment
    after = (step if step > 0 else -1) if resumed else None
    noted = {name: run.logged_rows(step, name) if step > 0 else None for name in (METRICS_FILE, FRONTS_FILE)}
    logger = loggers.enter_context(
        Logger(
            run.path,
            after=after,
            noted=noted[METRICS_FILE],
            wandb=experiment.logging.wandb,
            config={**experiment.to_dict(), "versions": run.versions},
            name=run.path.name,
            say=say,
        )
    )
    fronts = None if experiment.known_utility else FrontsFile(run.path / FRONTS_FILE, after, noted[FRONTS_FILE])
    if not run.locked:
        say("warning: the file system has no locks: start no other process on this run")
    if step == 0:
        run.metrics_gap = None  # everything is written again
    for gap in [gap for gap in (logger.gap, fronts and fronts.gap) if gap]:
        say(f"warning: {gap}; the run is continued")
        run.add_metrics_gap(gap)
    return _Record(run, step, logger, fronts)


def _last_checkpoint(run: Run, step: int) -> str:
    return f"the checkpoint of step {step:,} is intact" if run.checkpoint.exists() else "there is no checkpoint yet"


def _set_failed(runs: Sequence[Run], records: Sequence[_Record], begun: int, reason: str) -> None:
    _set_state(runs, records, begun, "failed", reason)


def _set_state(
    runs: Sequence[Run], records: Sequence[_Record], begun: int, state: Any, reason: str | None = None
) -> None:
    saved = {record.run.path: record.saved for record in records}
    for run in runs:
        with contextlib.suppress(OSError, Moved):  # these may be the reason; the original error is raised in any case
            run.set_status(state, saved.get(run.path, begun), reason)


def finish(run: Run, agent: Any, console: Console) -> None:
    """Evaluate the trained agent of a run; write and print the numbers, draw the learning curves and record a video.

    TensorBoard gets the hyperparameters with the final scores, and the video.

    An agent that learnt a front has the front evaluated and drawn, four of its policies filmed, and the page written on
    which a person chooses a policy. Without ``logging.save_figures`` there are neither curves nor videos nor the page.
    If any of these fails, the reason is printed and the run is finished all the same.

    Raises:
        Stopped: if the numbers could not be written; the trained policy is saved.
        Fault: if something is not finite, or an episode does not end.
    """
    settings, figures = run.experiment.evaluation, run.experiment.logging.save_figures
    video = run.path / VIDEO_FILE if figures else None
    try:
        run.check_place()
        report_agent(
            agent,
            run.experiment,
            console,
            episodes=settings.final_episodes,
            seed=settings.final_seed,
            directory=run.path,
            video=video,
        )
        if settings.task is not None:
            from algorithms.runs.suite_scores import scorable, score_run  # not earlier: it imports scipy.stats

            score_run(run, scorable(agent, run.experiment))
        if figures and not run.experiment.known_utility:
            with Accessory("no explorer", lambda text: print_line(console, text)):
                from algorithms.runs.front_explorer import write_explorer  # not earlier: only fronts need it

                write_explorer(run, agent, console)
        show_results(run, agent.step, console)
        run.set_status("finished", agent.step)
    except OSError as error:
        raise stopped_by(error, f"the run is trained, but its results could not be written: {error}") from error
    except Fault as error:
        fault = type(error)(f"in the final evaluation: {error}")
        _set_failed([run], [], agent.step, str(fault))
        raise fault from None
    except Exception as error:
        _set_failed([run], [], agent.step, f"{type(error).__name__}: {error}")
        raise
