"""Evaluations with the settings of an experiment, each on a new raw environment."""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.evaluation.episodes import OTHER_ENVS, OUR_ENVS, Evaluation, Policy, evaluate
from algorithms.evaluation.metrics import GREEDY, STOCHASTIC
from algorithms.experiments.build import make_environment
from algorithms.experiments.config import Experiment, find_environment, is_ours

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    from algorithms.evaluation.front import Front
    from algorithms.pcn import PCN

POLICIES = (GREEDY, STOCHASTIC)
FRONT_EPISODES = 256  # parallel environments for the episodes of all policies of a front


def evaluation_env(experiment: Experiment, episodes: int) -> VectorEnv:
    """A raw environment for evaluations of ``episodes`` episodes; the caller closes it."""
    ours = is_ours(find_environment(experiment.environment.id))
    return make_environment(experiment.environment, min(episodes, OUR_ENVS if ours else OTHER_ENVS))


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


def evaluate_front(agent: PCN, experiment: Experiment, *, episodes: int, seed: int) -> Front:
    """The front of a trained agent, from new episodes.

    Args:
        agent: trained.
        experiment: its environment and the discount of the evaluation.
        episodes: number of episodes of each policy.
        seed: seed of the first episode.
    """
    env = evaluation_env(experiment, FRONT_EPISODES)
    try:
        return agent.front(env, episodes=episodes, seed=seed, gamma=experiment.evaluation.gamma)
    finally:
        env.close()


def evaluate_front_policies(
    agent: PCN, front: Front, experiment: Experiment, *, episodes: int, seed: int
) -> list[Evaluation]:
    """New episodes of every policy of a front.

    Args:
        agent: the agent that learnt the front.
        front: K policies.
        experiment: its environment and the discount of the evaluation.
        episodes: number of episodes of each policy.
        seed: seed of the first episode.

    Returns:
        K evaluations, in the order of the front.
    """
    env = evaluation_env(experiment, FRONT_EPISODES)
    try:
        gamma = experiment.evaluation.gamma
        return agent.evaluate_policies(front.conditions, env, episodes=episodes, seed=seed, gamma=gamma)
    finally:
        env.close()
