"""Evaluations with the settings of an experiment, each on a new raw environment."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.runs.build import make_environment
from algorithms.runs.config import Experiment, find_environment, is_ours
from mo_deepdrive import suite
from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.episodes import OTHER_ENVS, OUR_ENVS, evaluate
from mo_deepdrive.evaluation.evaluation import Evaluation
from mo_deepdrive.evaluation.front import best_known_front, indicators
from mo_deepdrive.evaluation.metrics import ARRIVED, FRONT, GREEDY, STOCHASTIC, SUCCESS, SUITE
from mo_deepdrive.suite.scorers import SCORERS

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    from algorithms.agent import FrontAgent
    from mo_deepdrive.evaluation.front import Front
    from mo_deepdrive.evaluation.policy import Policy
    from mo_deepdrive.world.config import EnvironmentSettings

POLICIES = (GREEDY, STOCHASTIC)
FRONT_EPISODES = 256  # parallel environments for the episodes of all policies of a front


def evaluation_env(experiment: Experiment, episodes: int) -> VectorEnv:
    """A raw environment for evaluations of ``episodes`` episodes; the caller closes it."""
    ours = is_ours(find_environment(experiment.environment.id))
    return make_environment(experiment.environment, min(episodes, OUR_ENVS if ours else OTHER_ENVS))


def distinct_episodes(settings: EnvironmentSettings, episodes: int) -> int:
    """How many of ``episodes`` episodes of a deterministic policy are worth driving: 1 if all are the same, else all.

    They are the same if two seeds place the same world bit for bit, as with a fixed destination on OneWaypoint: this
    package's environments draw random numbers for nothing but the start of an episode. Of other environments this is
    not known, and all episodes are driven.
    """
    if episodes == 1 or not is_ours(find_environment(settings.id)):
        return episodes
    env: Any = make_environment(settings, 2)
    with closing(env):
        env.reset(seed=[0, 1])
        batch = env.unwrapped.batch
        # A scenario without an obstacle has the coordinates of one that nothing reads.
        names = [name for name in batch.state.dtype.names if name != "obstacle" or batch.params["has_obstacle"].any()]
        first, second = batch.state[names]
        return 1 if all(np.array_equal(first[name], second[name]) for name in names) else episodes


def final_metrics(experiment: Experiment) -> list[str]:
    """The names of the metrics that the final evaluation of an experiment may have, as ``stochastic/success``."""
    settings = experiment.evaluation
    with closing(evaluation_env(experiment, 1)) as env:
        adapter, best_known = EnvAdapter(env), best_known_front(env, settings.gamma)
    if experiment.known_utility:
        shape = (1, adapter.vehicles)
        zeros, ones = np.zeros((*shape, len(adapter.objectives))), np.ones(shape, dtype=np.int64)
        utilities: Any = (lambda returns: returns[..., 0],) * adapter.vehicles
        arrived = np.full(shape, ARRIVED, dtype=object)
        one = Evaluation(adapter.objectives, utilities, zeros, zeros, ones, ones == 1, arrived, zeros)
        known = [f"{policy}/{metric}" for policy in POLICIES for metric in one.metrics()]
    else:
        point = np.zeros((1, adapter.vehicles * len(adapter.objectives)))
        measured = indicators(point, reference_point=settings.reference_point, reference_front=best_known)
        known = [f"{FRONT}/{metric}" for metric in (*measured, SUCCESS)]
    if settings.task is not None:
        numbers_of_task = SCORERS[suite.load().task(settings.task).score].numbers
        known += [f"{policy}/{SUITE}{column}" for policy in POLICIES for column in numbers_of_task]
    return known


def evaluate_policies(policy: Policy, experiment: Experiment, *, episodes: int, seed: int) -> dict[str, Evaluation]:
    """Evaluate the greedy and the stochastic version of a policy; the evaluations by the names in :data:`POLICIES`."""
    gamma = experiment.evaluation.gamma
    with closing(evaluation_env(experiment, episodes)) as env:
        return {
            name: evaluate(policy, env, episodes=episodes, seed=seed, greedy=name == GREEDY, gamma=gamma)
            for name in POLICIES
        }


def evaluate_front(agent: FrontAgent, experiment: Experiment, *, episodes: int, seed: int) -> Front:
    """The front of a trained agent, from new episodes, of which :func:`distinct_episodes` are driven."""
    episodes = distinct_episodes(experiment.environment, episodes)
    with closing(evaluation_env(experiment, FRONT_EPISODES)) as env:
        return agent.front(env, episodes=episodes, seed=seed, gamma=experiment.evaluation.gamma)


def evaluate_front_policies(
    agent: FrontAgent, front: Front, experiment: Experiment, *, episodes: int, seed: int
) -> list[Evaluation]:
    """New episodes of every policy of the front that an agent learnt, of which :func:`distinct_episodes` are driven.

    Returns:
        An evaluation per policy, in the order of the front.
    """
    for kind, of_front, of_agent in (
        ("objectives", front.objectives, agent.front_objectives),
        ("conditions", front.condition_names, tuple(agent.condition_names)),
    ):
        if of_front != of_agent:
            raise ValueError(f"the front has the {kind} {of_front}; those of the agent are {of_agent}")
    episodes = distinct_episodes(experiment.environment, episodes)
    with closing(evaluation_env(experiment, FRONT_EPISODES)) as env:
        gamma = experiment.evaluation.gamma
        return agent.evaluate_policies(front.conditions, env, episodes=episodes, seed=seed, gamma=gamma)
