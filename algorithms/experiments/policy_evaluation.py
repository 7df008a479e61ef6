"""Evaluations with the settings of an experiment, each on a new raw environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.experiments.build import make_environment
from algorithms.experiments.config import Experiment, find_environment, is_ours
from mo_deepdrive.evaluation.episodes import OTHER_ENVS, OUR_ENVS, evaluate
from mo_deepdrive.evaluation.metrics import GREEDY, STOCHASTIC

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    from algorithms.agent import FrontAgent
    from mo_deepdrive.config import EnvironmentSettings
    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.front import Front
    from mo_deepdrive.evaluation.policy import Policy

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

    Args:
        settings: the environment.
        episodes: number of episodes of each policy.
    """
    if episodes == 1 or not is_ours(find_environment(settings.id)):
        return episodes
    env: Any = make_environment(settings, 2)
    try:
        env.reset(seed=[0, 1])
        batch = env.unwrapped.batch
        # A scenario without an obstacle has the coordinates of one that nothing reads.
        names = [name for name in batch.state.dtype.names if name != "obstacle" or batch.params["has_obstacle"].any()]
        first, second = batch.state[names]
        return 1 if all(np.array_equal(first[name], second[name]) for name in names) else episodes
    finally:
        env.close()


def evaluate_policies(policy: Policy, experiment: Experiment, *, episodes: int, seed: int) -> dict[str, Evaluation]:
    """Evaluate the greedy and the stochastic version of a policy.

    Args:
        policy: an agent, or anything that acts like one.
        experiment: its environment and the discount of the evaluation.
        episodes: number of episodes of each version.
        seed: seed of the first episode.

    Returns:
        The evaluations by the names in :data:`POLICIES`.
    """
    env = evaluation_env(experiment, episodes)
    try:
        return {
            name: evaluate(
                policy,
                env,
                episodes=episodes,
                seed=seed,
                greedy=name == GREEDY,
                gamma=experiment.evaluation.gamma,
            )
            for name in POLICIES
        }
    finally:
        env.close()


def evaluate_front(agent: FrontAgent, experiment: Experiment, *, episodes: int, seed: int) -> Front:
    """The front of a trained agent, from new episodes.

    Args:
        agent: trained.
        experiment: its environment and the discount of the evaluation.
        episodes: number of episodes of each policy, of which :func:`distinct_episodes` are driven.
        seed: seed of the first episode.
    """
    episodes = distinct_episodes(experiment.environment, episodes)
    env = evaluation_env(experiment, FRONT_EPISODES)
    try:
        return agent.front(env, episodes=episodes, seed=seed, gamma=experiment.evaluation.gamma)
    finally:
        env.close()


def evaluate_front_policies(
    agent: FrontAgent, front: Front, experiment: Experiment, *, episodes: int, seed: int
) -> list[Evaluation]:
    """New episodes of every policy of a front.

    Args:
        agent: the agent that learnt the front.
        front: K policies.
        experiment: its environment and the discount of the evaluation.
        episodes: number of episodes of each policy, of which :func:`distinct_episodes` are driven.
        seed: seed of the first episode.

    Returns:
        K evaluations, in the order of the front.

    Raises:
        ValueError: if the front is not one of this agent.
    """
    for what, found, own in (
        ("objectives", front.objectives, agent.front_objectives),
        ("conditions", front.condition_names, tuple(agent.condition_names)),
    ):
        if found != own:
            raise ValueError(f"the front has the {what} {found}; those of the agent are {own}")
    episodes = distinct_episodes(experiment.environment, episodes)
    env = evaluation_env(experiment, FRONT_EPISODES)
    try:
        gamma = experiment.evaluation.gamma
        return agent.evaluate_policies(front.conditions, env, episodes=episodes, seed=seed, gamma=gamma)
    finally:
        env.close()
