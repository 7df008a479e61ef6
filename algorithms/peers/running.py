"""From an experiment with a peer to a finished run: train it, evaluate what it has learnt as if it were ours."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from time import perf_counter
from typing import Any

import mo_gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from rich.console import Console

from algorithms.evaluation import evaluate, evaluate_each
from algorithms.experiment import Experiment, find_environment, is_ours
from algorithms.files import write_json
from algorithms.front import Front
from algorithms.front_plots import draw_front
from algorithms.logging import Logger
from algorithms.pareto import indicators
from algorithms.peers import PEERS
from algorithms.peers.environment import Recorder
from algorithms.peers.task import PeerConfig, Policies, Task
from algorithms.plots import load_groups, plot
from algorithms.reports import table, write
from algorithms.runs import Run
from algorithms.training import OTHER_WORLDS, OUR_WORLDS, POLICIES, film
from algorithms.worlds import Worlds, make_env
from mo_deepdrive.config import parse
from mo_deepdrive.fronts import pareto_front, reference_point
from mo_deepdrive.utilities import make_utility

LINES = 100  # of training metrics in a run


@dataclass(frozen=True)
class Trained:
    """What came out of training.

    Attributes:
        policies: as the adapter gives them.
        steps: environment steps taken.
        seconds: wall-clock time of the training alone.
    """

    policies: Policies
    steps: int
    seconds: float


def prepare(experiment: Experiment, log: Any) -> Task:
    """What the experiment's peer is to learn.

    Args:
        experiment: with the name of a peer as its algorithm.
        log: called as ``log(step, metrics)``.

    Raises:
        ValueError: if peer, environment and utility do not fit together, or the peer is not installed.
    """
    name = experiment.algorithm["name"]
    peer, settings, training = PEERS[name], experiment.environment, experiment.training
    obstacle = peer.obstacle()
    if obstacle is not None:
        raise ValueError(f"algorithm {name!r} cannot run here: {obstacle}; install {peer.package}")
    config = parse(peer.Config, experiment.hyperparameters, f"settings of algorithm {name!r}")
    worlds = Worlds(make_env(settings.id, 1, settings.arguments))
    chosen = experiment.utility
    utility = None
    if chosen is not None:
        utility = make_utility(chosen.name, worlds.objectives, cost_sign=worlds.cost_sign, **chosen.arguments)

    def new(render_mode: str | None = None) -> Any:
        return mo_gymnasium.make(settings.id, render_mode=render_mode, **settings.arguments)

    corner = _references(worlds, experiment.evaluation.gamma, config)[0]
    task = Task(
        new=new,
        worlds=worlds,
        config=config,
        utility=utility,
        steps=training.total_timesteps,
        num_envs=training.num_envs,
        seed=training.seed,
        device=training.device,
        reference_point=np.zeros(len(worlds.objectives)) if corner is None else corner,
        recorder=Recorder(worlds.objectives, utility, max(1, training.total_timesteps // LINES), log),
    )
    peer.check(name, task)
    return task


def _references(
    worlds: Worlds, gamma: float, config: PeerConfig
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Reference point (d,) and best-known front (k, d) of an environment; None where there is none."""
    if "ref_point" in config.train_arguments:
        corner = np.asarray(config.train_arguments["ref_point"], dtype=np.float64)
        if config.nominal_scales:
            corner = corner * worlds.objective_scales
        return corner, None
    if not worlds.native:
        return None, None
    own: Any = worlds.env.unwrapped
    scenario, kind = own.config.scenario, own.config.action_type
    point = None
    front = None
    with contextlib.suppress(ValueError):  # no reference point at this gamma
        point = reference_point(scenario, kind, gamma, worlds.objectives).values
    with contextlib.suppress(ValueError):  # no front of this environment
        front = np.array(pareto_front(own.config, gamma))
    return point, front


def train(run: Run) -> Trained:
    """Train the run's peer; its own output goes to ``peer.log``, our metrics to ``metrics.csv``.

    Seeding the global generators, which peers draw from, is the caller's part.

    Raises:
        ValueError: as :func:`prepare`.
    """
    with Logger(
        run.path, wandb=run.experiment.logging.wandb, config=run.experiment.to_dict(), name=run.path.name
    ) as log:
        task = prepare(run.experiment, log.log)
        peer = PEERS[run.experiment.algorithm["name"]]
        with (run.path / "peer.log").open("w", buffering=1) as file, contextlib.redirect_stdout(file):
            started = perf_counter()
            policies = peer.adapter(task)
            seconds = perf_counter() - started
    run.set_status("trained", task.recorder.steps)
    return Trained(policies, task.recorder.steps, seconds)


def finish(run: Run, trained: Trained, console: Console) -> None:
    """Evaluate what was learnt on raw environments and our seeds, write the numbers, draw them.

    Raises:
        OSError: if something cannot be written.
    """
    experiment, policies = run.experiment, trained.policies
    settings, name = experiment.evaluation, experiment.algorithm["name"]
    peer = PEERS[name]
    about = {
        "step": trained.steps,
        "wall_clock": trained.seconds,
        "peer": {"name": name, "package": peer.package, "version": metadata.version(peer.package)},
        "episodes": settings.final_episodes,
        "seed": settings.seed,
        "gamma": settings.gamma,
    }
    env = _evaluation_env(experiment, settings.final_episodes * len(policies))
    try:
        if peer.known_utility:
            policy = policies.at(np.zeros(1, dtype=np.intp))
            found = {
                each: evaluate(
                    policy,
                    env,
                    episodes=settings.final_episodes,
                    seed=settings.seed,
                    greedy=each == "greedy",
                    gamma=settings.gamma,
                )
                for each in POLICIES
            }
            console.print(table(found, f"{settings.final_episodes} episodes from seed {settings.seed}"))
            write(run.path, found, about)
            film(policy, experiment, run.path / "video.mp4", console, seed=settings.seed)  # type: ignore[arg-type]
        else:
            front = evaluate_front(policies, env, experiment)
            report_front(run, front, policies.task, about, console)
    finally:
        env.close()
    _curves(run, trained)
    run.set_status("finished", trained.steps)


def _evaluation_env(experiment: Experiment, episodes: int) -> VectorEnv:
    ours = is_ours(find_environment(experiment.environment.id))
    worlds = min(episodes, OUR_WORLDS if ours else OTHER_WORLDS)
    return make_env(experiment.environment.id, worlds, experiment.environment.arguments)


def evaluate_front(policies: Policies, env: VectorEnv, experiment: Experiment) -> Front:
    """The non-dominated ones of ``policies``, each greedy in the experiment's evaluation episodes."""
    settings = experiment.evaluation
    found = evaluate_each(
        policies.at,
        len(policies),
        env,
        episodes=settings.final_episodes,
        seed=settings.seed,
        gamma=settings.gamma,
    )
    says = any(each.succeeded.any() or (each.ends != None).any() for each in found)  # noqa: E711  (per element)
    front = Front.of_episodes(
        policies.task.objectives,
        [each.returns[:, 0] for each in found],
        [each.discounted[:, 0] for each in found],
        [each.lengths[:, 0] for each in found],
        [each.succeeded[:, 0] for each in found] if says else None,
        policies.conditions,
        policies.condition_names,
        gamma=settings.gamma,
        seed=settings.seed,
    )
    return front.non_dominated()


def report_front(run: Run, front: Front, task: Task, about: Mapping[str, Any], console: Console) -> None:
    """Write a front with its indicators and draw it.

    Raises:
        OSError: if something cannot be written.
    """
    corner, best = _references(task.worlds, front.gamma, task.config)
    measured = indicators(
        front.discounted, reference_point=corner, reference_front=best, scales=task.worlds.objective_scales
    )
    point = None if corner is None else corner.tolist()
    front.write(run.path, {**about, "reference_point": point, "indicators": measured})
    title = f"{run.experiment.algorithm['name']} on {run.experiment.environment.id}"
    if len(front.objectives) > 1:
        draw_front(front, run.path, reference_front=best, title=title)
    console.print(f"{len(front)} policies; " + ", ".join(f"{name} {value:.4g}" for name, value in measured.items()))


def _curves(run: Run, trained: Trained) -> None:
    if trained.steps >= max(1, run.experiment.training.total_timesteps // LINES):
        plot(load_groups([run.path]), run.path / "curves.png")
    else:
        write_json(run.path / "curves.json", {"reason": "the training was too short for a line of metrics"})
