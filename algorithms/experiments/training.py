"""From an experiment to a finished run: build, train with checkpoints, evaluate, draw, film."""

from __future__ import annotations

import contextlib
import errno
import signal
import threading
from collections.abc import Callable, Mapping
from types import FrameType, TracebackType
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from rich.console import Console

from algorithms import ALGORITHMS
from algorithms.agent import Agent
from algorithms.common.env_adapter import EnvAdapter, make_env
from algorithms.common.metrics_file import FrontsFile
from algorithms.evaluation.evaluate import Evaluation, Policy, evaluate
from algorithms.evaluation.front import Front, best_known_front, check_reference_point
from algorithms.experiments.config import EnvironmentSettings, Experiment, UtilitySettings, find_environment, is_ours
from algorithms.experiments.loggers import Logger
from algorithms.experiments.progress_bar import ProgressReporter
from algorithms.experiments.run_directory import Run
from algorithms.pcn import PCN
from algorithms.reporting.front_report import film_front, report_front
from algorithms.reporting.learning_curves import load_groups, plot
from algorithms.reporting.tables import evaluation_table, write_evaluation
from algorithms.reporting.videos import record
from mo_deepdrive.config import nearest
from mo_deepdrive.utilities import Utility, make_utility

POLICIES = ("greedy", "stochastic")
# Parallel worlds of an evaluation: ours cost next to nothing, others one Python step each.
OUR_WORLDS, OTHER_WORLDS = 256, 8
FRONT_EPISODES = 256  # a front's policies and their episodes, side by side


class Stopped(Exception):
    """Training cannot go on for a reason outside of it; the message says what to do."""


class DiskFull(Stopped):
    """There is no space left to write to."""


def no_space(error: OSError) -> bool:
    """Whether the disk, or a quota, is full."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def stopped(message: str, error: OSError) -> Stopped:
    """What to raise with this message after an error of the operating system."""
    return (DiskFull if no_space(error) else Stopped)(message)


def build(experiment: Experiment, num_envs: int | None = None) -> Any:
    """The agent of an experiment, untrained, with its training environment.

    Args:
        experiment: what to build.
        num_envs: instead of the experiment's.

    Raises:
        ValueError: if environment, utility and hyperparameters do not fit together.
    """
    name = experiment.algorithm["name"]
    if name not in ALGORITHMS:
        raise ValueError(f"algorithm {name!r} is another library's; scripts/peers.py runs it")
    torch.set_num_threads(experiment.training.threads)
    env = make(experiment.environment, num_envs or experiment.training.num_envs)
    worlds = EnvAdapter(env)
    given: dict[str, Any] = {}
    if experiment.utility is None:
        check_reference_point(experiment.evaluation.reference_point, worlds.objectives)
    else:
        given["utility"] = _utilities(experiment.utility, worlds)
    return ALGORITHMS[name](
        env,
        **given,
        seed=experiment.training.seed,
        device=experiment.training.device,
        **experiment.hyperparameters,
    )


def _utilities(settings: UtilitySettings, worlds: EnvAdapter) -> list[Utility]:
    """One utility per vehicle, each tried."""
    vehicles = [f"vehicle_{v}" for v in range(worlds.vehicles)]
    for name in settings.vehicles:
        if name not in vehicles:
            raise ValueError(f"utility.vehicles has {name!r}; {nearest(name, vehicles)}")
    utilities = []
    for v in range(worlds.vehicles):
        chosen = settings.of_vehicle(v)
        utilities.append(make_utility(chosen.name, worlds.objectives, cost_sign=worlds.cost_sign, **chosen.arguments))
        _try(utilities[-1])
    return utilities


def make(settings: EnvironmentSettings, num_envs: int) -> VectorEnv:
    """The environment of an experiment.

    Raises:
        ValueError: if it cannot be made with these arguments.
    """
    try:
        return make_env(settings.id, num_envs, settings.arguments)
    except ValueError:
        raise
    except Exception as error:
        if is_ours(find_environment(settings.id)):
            raise
        # Somebody else's environment, which may fail in any way, mostly for its arguments.
        raise ValueError(
            f"environment {settings.id!r} with arguments {settings.arguments} cannot be made: "
            f"{type(error).__name__}: {error}"
        ) from error


def _try(utility: Utility) -> None:
    """Call a utility as the trainers will, so that a user's own fails here and not after an hour."""
    d = len(utility.objectives)
    for returns in (np.zeros((2, d)), torch.zeros(2, d)):
        try:
            shape = tuple(utility(returns).shape)
        except Exception as error:
            raise ValueError(
                f"utility {utility.name!r} fails on returns of shape (2, {d}) as {type(returns).__module__}: "
                f"{type(error).__name__}: {error}"
            ) from error
        if shape != (2,):
            raise ValueError(f"utility {utility.name!r} gives shape {shape} for returns of shape (2, {d}), not (2,)")


class Interrupts:
    """Takes note of SIGINT and SIGTERM while it is open; a second signal acts at once, as without it.

    Only the main thread receives signals; elsewhere it notes none.

    Attributes:
        received: the signal's number, 0 for a request of another kind, or None.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, Any] = {}

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._restore()


def resume(run: Run) -> Any:
    """The agent of a run whose lock is held, as its last checkpoint left it; untrained where there is none.

    Raises:
        ValueError: if it cannot be built or loaded.
    """
    agent = build(run.experiment)
    if run.checkpoint.exists():
        agent.load(run.checkpoint)
    return agent


def train(
    run: Run,
    agent: Agent,
    console: Console,
    *,
    resumed: bool = False,
    watch: Callable[[int, Mapping[str, float]], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> int | None:
    """Train ``agent`` to the end of the run's experiment, or until SIGINT or SIGTERM; either way save it.

    When it ends or stops changes nothing about what is learnt: checkpoints and evaluations go by steps alone.

    Args:
        run: where everything is written.
        agent: new, or loaded from the run's checkpoint.
        console: for the progress.
        resumed: whether the run has begun before; its metrics are continued.
        watch: called with the step and the metrics of every row logged.
        stop: asked after every update; True saves and stops as a signal does.

    Returns:
        The signal that stopped it, 0 if ``stop`` did, or None at the end of the training.

    Raises:
        Stopped: if something could not be written; the last checkpoint is whole.
    """
    experiment = run.experiment
    training, evaluation, logging = experiment.training, experiment.evaluation, experiment.logging
    every = logging.checkpoint_interval or training.total_timesteps
    saved = agent.step
    known_utility = experiment.known_utility
    eval_env = evaluation_env(experiment, evaluation.episodes if known_utility else FRONT_EPISODES)
    reference_front = None if known_utility else best_known_front(eval_env, evaluation.gamma)
    ours = is_ours(find_environment(experiment.environment.id))
    after = (saved if saved > 0 else -1) if resumed else None
    config = {**experiment.to_dict(), "versions": run.versions}
    try:
        with (
            Interrupts() as interrupts,
            ProgressReporter(
                training.total_timesteps, saved, console, arrivals=ours, front=not known_utility
            ) as reporter,
            Logger(
                run.path, after=after, wandb=logging.wandb, config=config, name=run.path.name, say=reporter.say
            ) as logger,
        ):

            def log(step: int, metrics: Mapping[str, float]) -> None:
                logger.log(step, metrics)
                reporter.note(metrics)
                if watch is not None:
                    watch(step, metrics)

            fronts = None if known_utility else FrontsFile(run.path / "fronts.csv", after)

            def save(state: Any) -> None:
                nonlocal saved
                agent.save(run.checkpoint)
                saved = agent.step
                run.set_status(state, saved)

            def after_update(trained: Agent) -> bool:
                reporter.update(trained.step)
                if trained.step // every > saved // every:
                    save("running")
                if interrupts.received is None and stop is not None and stop():
                    interrupts.received = 0
                return interrupts.received is not None

            run.set_status("running", saved)
            agent.train(
                training.total_timesteps,
                eval_env,
                eval_interval=evaluation.interval,
                eval_episodes=evaluation.episodes,
                eval_seed=evaluation.seed,
                eval_gamma=evaluation.gamma,
                reference_point=evaluation.reference_point,
                reference_front=reference_front,
                log=log,
                log_front=None if fronts is None else fronts.write,
                log_interval=logging.interval,
                after_update=after_update,
            )
            save("trained" if interrupts.received is None else "interrupted")
    except OSError as error:
        _failed(run, saved, str(error))
        keeps = (
            f"the checkpoint of step {saved:,} is whole" if run.checkpoint.exists() else "there is no checkpoint yet"
        )
        raise stopped(f"training stopped at step {agent.step:,}: {error}; {keeps}", error) from error
    except BaseException as error:
        _failed(run, saved, f"{type(error).__name__}: {error}")
        raise
    finally:
        eval_env.close()
    return interrupts.received


def _failed(run: Run, step: int, reason: str) -> None:
    with contextlib.suppress(OSError):  # the disk may be what failed; the error itself is on its way
        run.set_status("failed", step, reason)


def evaluate_policies(agent: Policy, experiment: Experiment, *, episodes: int, seed: int) -> dict[str, Evaluation]:
    """The greedy and the stochastic policy's evaluations, on an environment of their own."""
    env = evaluation_env(experiment, episodes)
    try:
        return {
            policy: evaluate(
                agent,
                env,
                episodes=episodes,
                seed=seed,
                greedy=policy == "greedy",
                gamma=experiment.evaluation.gamma,
            )
            for policy in POLICIES
        }
    finally:
        env.close()


def evaluation_env(experiment: Experiment, episodes: int) -> VectorEnv:
    """A raw environment of its own for evaluations of so many episodes."""
    ours = is_ours(find_environment(experiment.environment.id))
    return make(experiment.environment, min(episodes, OUR_WORLDS if ours else OTHER_WORLDS))


def finish(run: Run, agent: Agent, console: Console) -> None:
    """Evaluate the trained agent; write and print the numbers; draw the curves; film the greedy policy.

    Where the agent learnt a front, it is re-evaluated and drawn, and four of its policies are filmed. Without
    ``logging.save_figures`` the numbers are all.

    Raises:
        Stopped: if the numbers or the curves could not be written; the trained policy is safe.
    """
    try:
        if run.experiment.known_utility:
            _finish_policy(run, agent, console)
        else:
            _finish_front(run, agent, console)
        run.set_status("finished", agent.step)
    except OSError as error:
        raise stopped(f"the run is trained, but its results could not be written: {error}", error) from error


def _finish_policy(run: Run, agent: Agent, console: Console) -> None:
    experiment = run.experiment
    settings = experiment.evaluation
    evaluations = evaluate_policies(agent, experiment, episodes=settings.final_episodes, seed=settings.seed)
    about = {
        "step": agent.step,
        "episodes": settings.final_episodes,
        "seed": settings.seed,
        "gamma": settings.gamma,
    }
    console.print(evaluation_table(evaluations, f"{settings.final_episodes} episodes from seed {settings.seed}"))
    write_evaluation(run.path, evaluations, about)
    if experiment.logging.save_figures:
        plot(load_groups([run.path]), run.path / "curves.png")
        film(agent, experiment, run.path / "video.mp4", console, seed=settings.seed)


def evaluate_front(agent: PCN, experiment: Experiment, *, episodes: int, seed: int) -> Front:
    """The front of a trained agent, evaluated anew on an environment of its own."""
    env = evaluation_env(experiment, FRONT_EPISODES)
    try:
        return agent.front(env, episodes=episodes, seed=seed, gamma=experiment.evaluation.gamma)
    finally:
        env.close()


def evaluate_policies_of(
    agent: PCN, front: Front, experiment: Experiment, *, episodes: int, seed: int
) -> list[Evaluation]:
    """Episodes of every policy of a front that ``agent`` learnt, on an environment of their own."""
    env = evaluation_env(experiment, FRONT_EPISODES)
    try:
        gamma = experiment.evaluation.gamma
        return agent.evaluate_policies(front.conditions, env, episodes=episodes, seed=seed, gamma=gamma)
    finally:
        env.close()


def _finish_front(run: Run, agent: Any, console: Console) -> None:
    environment, settings = run.experiment.environment, run.experiment.evaluation
    front = evaluate_front(agent, run.experiment, episodes=settings.final_episodes, seed=settings.seed)
    report_front(
        front,
        console,
        algorithm=run.experiment.algorithm["name"],
        env_id=environment.id,
        env_arguments=environment.arguments,
        reference_point=settings.reference_point,
        directory=run.path,
        about={"step": agent.step},
    )
    if not run.experiment.logging.save_figures:
        return
    plot(load_groups([run.path]), run.path / "curves.png")
    path = run.path / "video.mp4"
    attempt_film(
        lambda: film_front(agent, front, environment.id, environment.arguments, path, seed=settings.seed), console
    )


def film(
    policy: Policy, experiment: Experiment, path: Any, console: Console, *, seed: int, greedy: bool = True
) -> bool:
    """Record a video, or say why there is none; whether there is one."""
    env = experiment.environment
    return attempt_film(lambda: record(policy, env.id, env.arguments, path, seed=seed, greedy=greedy), console)


def attempt_film(recording: Callable[[], Any], console: Console) -> bool:
    """Do what records a video, or say why there is none; whether there is one."""
    try:
        recording()
    except Exception as error:  # drawing and encoding are other people's code; the numbers are worth more
        console.print(f"no video: {type(error).__name__}: {error}", markup=False, highlight=False, soft_wrap=True)
        return False
    return True
