"""Train an agent with checkpoints, then evaluate it, plot its curves and record a video."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from algorithms.experiments.accessories import Accessory
from algorithms.experiments.agent_report import VIDEO_FILE, report_agent, show_results
from algorithms.experiments.build import build
from algorithms.experiments.config import check_loggers, find_environment, is_ours, make_experiment
from algorithms.experiments.console import print_line
from algorithms.experiments.interrupts import PATIENCE, Interrupts, Moved, stopped_by
from algorithms.experiments.loggers import Logger
from algorithms.experiments.policy_evaluation import FRONT_EPISODES, distinct_episodes, evaluation_env
from algorithms.experiments.progress_bar import ProgressReporter, compilation_noted
from algorithms.experiments.run_directory import FRONTS_FILE, METRICS_FILE, Run
from algorithms.files.checkpoints import read_checkpoint
from algorithms.files.fronts import FrontsFile
from algorithms.files.metrics import rows_until
from algorithms.files.yaml import dump
from mo_deepdrive.atomic_io import atomic_write
from mo_deepdrive.evaluation.front import best_known_front
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.faults import Fault

if TYPE_CHECKING:
    from rich.console import Console

    from algorithms.agent import Agent
    from mo_deepdrive.evaluation.front import Front

Watch = Callable[[int, Mapping[str, float]], None]


def resume(run: Run) -> Any:
    """The agent of a run whose lock is held, from its last checkpoint; untrained if there is none.

    Raises:
        ValueError: if it cannot be built or loaded.
    """
    agent = build(run.experiment)
    if run.checkpoint.exists():
        agent.load(run.checkpoint)
    return agent


def reopen(path: str, *, trust: bool = False, total_timesteps: Any = None) -> tuple[Run, Any]:
    """Open and lock an existing run, to resume it; the run and its agent.

    Args:
        path: the run's directory.
        trust: allow a config.yaml that names code to import.
        total_timesteps: a new, greater length of the training; None for that of the run.

    Raises:
        ValueError: if there is no run, another process trains in it, its config.yaml is not trusted, its checkpoint or
            its metrics cannot be resumed from, or it cannot be trained longer.
        OSError: if the directory cannot be written.
    """
    run = Run.open(path, trust=trust)
    experiment = run.experiment
    check_loggers(experiment)
    if total_timesteps is not None:
        values = experiment.to_dict()
        values["training"]["total_timesteps"] = total_timesteps
        experiment = make_experiment(values)
        length = run.experiment.training.total_timesteps
        if experiment.training.total_timesteps <= length:
            raise ValueError(
                f"training.total_timesteps = {total_timesteps} must be more than the {length:,} of the run"
            )
    if run.checkpoint.exists():
        read_checkpoint(run.checkpoint, {}, whole=True)  # a policy of the zoo is refused before a lock is written
    run.lock()
    agent = resume(run)
    for name in (METRICS_FILE, FRONTS_FILE):
        rows_until(run.path / name, agent.step)
    if experiment is not run.experiment:
        if agent.schedules:
            run.unlock()
            raise ValueError(
                f"training.total_timesteps = {experiment.training.total_timesteps}: the run cannot be trained longer, "
                f"since these settings depend on the length of the training: {', '.join(agent.schedules)}"
            )
        run.experiment = experiment
        # In this order: a process that is killed in between leaves a run that can be resumed.
        run.set_status("running", agent.step)
        atomic_write(run.path / "config.yaml", dump(experiment.to_dict()).encode())
    return run, agent


def train_and_finish(
    run: Run,
    agent: Any,
    console: Console,
    *,
    resumed: bool = False,
    watch: Watch | None = None,
    stop: Callable[[], bool] | None = None,
) -> int | None:
    """Call :func:`train` and, unless it was stopped, :func:`finish`; arguments, result and errors are theirs."""
    received = train(run, agent, console, resumed=resumed, watch=watch, stop=stop)
    if received is None:
        finish(run, agent, console)
    return received


def train(
    run: Run,
    agent: Agent,
    console: Console,
    *,
    resumed: bool = False,
    watch: Watch | None = None,
    stop: Callable[[], bool] | None = None,
) -> int | None:
    """Train ``agent`` to the end of the run's experiment, or until SIGINT or SIGTERM, and save it in either case.

    Stopping and resuming do not affect what is learnt: checkpoints and evaluations depend on the step alone. After a
    signal the update, or the evaluation, goes on to its end and is saved if that takes no longer than PATIENCE and
    there is no second SIGINT; else the run resumes from its last checkpoint.

    Args:
        run: its directory receives everything that is written.
        agent: new, or loaded from the run's checkpoint.
        console: for the progress.
        resumed: whether the run was started before, so that its metrics are continued.
        watch: called with the step and the metrics of every logged row.
        stop: called after every update; True saves and stops as a signal does.

    Returns:
        The number of the signal that stopped training, 0 if ``stop`` did, or None if training is complete.

    Raises:
        Stopped: if something could not be written; the last checkpoint is intact.
        Fault: if something is not finite, or an episode does not end; the last checkpoint is intact.
    """
    experiment = run.experiment
    training, evaluation, logging = experiment.training, experiment.evaluation, experiment.logging
    checkpoint_interval = logging.checkpoint_interval or training.total_timesteps
    saved = agent.step  # step of the last checkpoint
    known_utility = experiment.known_utility
    episodes = evaluation.episodes
    if not known_utility:
        episodes = distinct_episodes(experiment.environment, episodes)
    eval_env = evaluation_env(experiment, episodes if known_utility else FRONT_EPISODES)
    reference_front = None if known_utility else best_known_front(eval_env, evaluation.gamma)
    ours = is_ours(find_environment(experiment.environment.id))
    after = (saved if saved > 0 else -1) if resumed else None
    config = {**experiment.to_dict(), "versions": run.versions}
    noted = {name: run.logged_rows(saved, name) if saved > 0 else None for name in (METRICS_FILE, FRONTS_FILE)}
    interrupts = Interrupts(PATIENCE)
    try:
        with (
            interrupts,
            ProgressReporter(
                training.total_timesteps, saved, console, arrivals=ours, front=not known_utility
            ) as reporter,
            compilation_noted(reporter.say),
            Logger(
                run.path,
                after=after,
                noted=noted[METRICS_FILE],
                wandb=logging.wandb,
                config=config,
                name=run.path.name,
                say=reporter.say,
            ) as logger,
        ):

            def log(step: int, metrics: Mapping[str, float]) -> None:
                run.check_place()
                logger.log(step, metrics)
                reporter.note(metrics)
                if watch is not None:
                    watch(step, metrics)

            fronts = None if known_utility else FrontsFile(run.path / FRONTS_FILE, after, noted[FRONTS_FILE])
            if not run.locked:
                reporter.say("warning: the file system has no locks: start no other process on this run")
            if saved == 0:
                run.metrics_gap = None  # everything is written again
            gaps = [gap for gap in (logger.gap, fronts and fronts.gap) if gap]
            for gap in gaps:
                reporter.say(f"warning: {gap}; the run is continued")
                run.add_metrics_gap(gap)

            def log_front(step: int, front: Front) -> None:
                run.check_place()
                assert fronts is not None
                fronts.write(step, front)

            def save(state: Any) -> None:
                nonlocal saved
                run.check_place()
                # In this order, so that a crash cannot leave a checkpoint without its rows or their note.
                rows = {METRICS_FILE: logger.sync(), **({} if fronts is None else {FRONTS_FILE: fronts.sync()})}
                run.note_rows(agent.step, rows)
                run.set_status("running", saved)
                agent.save(run.checkpoint)
                saved = agent.step
                run.set_status(state, saved)

            def after_update(trained: Agent) -> bool:
                reporter.update(trained.step)
                if trained.step // checkpoint_interval > saved // checkpoint_interval:
                    save("running")
                if interrupts.received is None and stop is not None and stop():
                    interrupts.received = 0
                interrupts.settle()
                return interrupts.received is not None

            run.set_status("running", saved)
            agent.train(
                training.total_timesteps,
                eval_env,
                eval_interval=evaluation.interval,
                eval_episodes=episodes,
                eval_seed=SPLITS["validation"].start,
                eval_gamma=evaluation.gamma,
                reference_point=evaluation.reference_point,
                reference_front=reference_front,
                log=log,
                log_front=None if fronts is None else log_front,
                log_interval=logging.interval,
                after_update=after_update,
            )
            save("trained" if interrupts.received is None else "interrupted")
    except (OSError, Moved) as error:
        try:
            run.check_place()
        except Moved as moved:
            text = f"training stopped at step {agent.step:,}: {moved}; resume it from where it is now"
            raise Moved(text) from None
        if isinstance(error, Moved):
            raise
        _set_failed(run, saved, str(error))
        rest = (
            f"the checkpoint of step {saved:,} is intact" if run.checkpoint.exists() else "there is no checkpoint yet"
        )
        raise stopped_by(error, f"training stopped at step {agent.step:,}: {error}; {rest}") from error
    except Fault as error:
        _set_failed(run, saved, str(error))
        raise
    except KeyboardInterrupt as error:
        if not interrupts.received:
            _set_failed(run, saved, f"{type(error).__name__}: {error}")
            raise
        with contextlib.suppress(OSError):
            run.set_status("interrupted", saved)
    except BaseException as error:
        _set_failed(run, saved, f"{type(error).__name__}: {error}")
        raise
    finally:
        eval_env.close()
    return interrupts.received


def _set_failed(run: Run, step: int, reason: str) -> None:
    with contextlib.suppress(OSError, Moved):  # these may be the reason; the original error is raised in any case
        run.set_status("failed", step, reason)


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
            from algorithms.experiments.suite_scores import scorable, score_run  # not earlier: it imports scipy.stats

            score_run(run, scorable(agent, run.experiment))
        if figures and not run.experiment.known_utility:
            with Accessory("no explorer", lambda text: print_line(console, text)):
                from algorithms.experiments.front_explorer import write_explorer  # not earlier: only fronts need it

                write_explorer(run, agent, console)
        show_results(run, agent.step, console)
        run.set_status("finished", agent.step)
    except OSError as error:
        raise stopped_by(error, f"the run is trained, but its results could not be written: {error}") from error
    except Fault as error:
        fault = type(error)(f"in the final evaluation: {error}")
        _set_failed(run, agent.step, str(fault))
        raise fault from None
    except Exception as error:
        _set_failed(run, agent.step, f"{type(error).__name__}: {error}")
        raise
