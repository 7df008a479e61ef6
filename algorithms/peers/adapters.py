"""Adapters: how algorithms of morl-baselines and Stable-Baselines3 are trained, and how the resulting policies act.

Every adapter trains an algorithm with the library's own training loop and defaults on
:class:`algorithms.peers.peer_task.PeerEnv`; comments explain exceptions.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import gymnasium
import numpy as np
import torch

from algorithms.peers.peer_task import (
    PeerPolicies,
    PeerTask,
    PolicyInputs,
    RecordedEpisodes,
    ScalarConfig,
    WeightedConfig,
    as_array,
)
from mo_deepdrive.evaluation.pareto import evenly_spaced_weights, non_dominated
from mo_deepdrive.wrappers import UtilityReward, VectorScaledObservation, VectorUtilityReward

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.utilities import Utility

EVALUATION_EPISODES = 1  # of the algorithms' own evaluations during training, which are not reported
# Number of weights for evaluations that the algorithms only log; computing them at the start is slow.
LOGGED_WEIGHTS = 10
HORIZON_SCALE = 0.1  # of PCN's and LCN's horizons, as in the library's examples
NORMAL_EPSILON = 1e-8  # of Gymnasium's normalisation of observations
UNBOUNDED = 100.0  # the library's own limit of desired returns without a bound


def _arguments(task: PeerTask, **defaults: Any) -> dict[str, Any]:
    """Arguments of a constructor; morl-baselines only logs to Weights & Biases, and the recorder logs instead."""
    return task.arguments(log=False, **defaults)


def _train(task: PeerTask, agent: Any, **defaults: Any) -> dict[str, Any]:
    """Train an agent, which evaluates itself on an environment that is not recorded; the arguments that it got."""
    defaults = {"eval_env": task.make(recorded=False), "ref_point": _reference(task), **defaults}
    arguments = task.train_arguments(**defaults)
    agent.train(task.steps, **arguments)
    return arguments


def _reference(task: PeerTask) -> NDArray[np.float32]:
    """The reference point in the peer's units; zeros if there is none, for peers that only log the hypervolume."""
    if task.reference_point is None:
        return np.zeros(len(task.env.objectives), dtype=np.float32)
    return (task.reference_point / task.reward_scales).astype(np.float32)


def _sample(probabilities: torch.Tensor, generator: torch.Generator | None) -> torch.Tensor:
    """Actions (N,) sampled from ``probabilities`` (N, actions), or the most probable ones without a generator."""
    if generator is None:
        return probabilities.argmax(-1)
    return torch.multinomial(probabilities, 1, generator=generator)[:, 0]


def _networks(
    task: PeerTask,
    acts: Sequence[Callable[[PolicyInputs], Any]],
    prefix: str,
    vectors: Sequence[Any],
    gamma: float = 1.0,
) -> PeerPolicies:
    """One policy per network, of which ``acts`` has the actions for inputs, and ``vectors`` (d,) the weights.

    ``gamma`` is the discount of the accrued rewards in the inputs, ``prefix`` that of the names of the conditions.
    """
    shape = (task.env.actions,) if task.env.continuous else ()
    kind = np.float32 if task.env.continuous else np.int64

    def choose(rows: NDArray[np.intp], inputs: PolicyInputs) -> NDArray[Any]:
        actions = np.zeros((len(rows), *shape), dtype=kind)
        for policy in np.unique(rows):
            mine = rows == policy
            actions[mine] = as_array(acts[policy](inputs.select(mine)))
        return actions

    # Several networks may have been trained for the same vector, so conditions start with a number.
    conditions = np.column_stack([np.arange(len(acts)), np.array(vectors, dtype=np.float64)])
    names = ("network", *(f"{prefix}/{name}" for name in task.env.objectives))
    return PeerPolicies(task, choose, conditions, names, gamma)


def _weighted(task: PeerTask, act: Callable[[torch.Tensor, torch.Tensor], Any]) -> PeerPolicies:
    """One policy per weight vector of a network that takes weights; ``act`` takes (N, o) and (N, d)."""
    config = task.config
    assert isinstance(config, WeightedConfig)
    d = len(task.env.objectives)
    weights = evenly_spaced_weights(d, max(config.policies, d))

    def choose(rows: NDArray[np.intp], inputs: PolicyInputs) -> Any:
        return act(task.tensor(inputs.observations), task.tensor(weights[rows]))

    return PeerPolicies(task, choose, weights, tuple(f"weight/{name}" for name in task.env.objectives))


def conditioned_on_returns(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Pareto Conditioned Networks (Reymond et al. 2022) and Lorenz Conditioned Networks (Michailidis et al. 2026).

    There is one policy per non-dominated episode in the replay buffer.
    """
    env = task.make()
    scaling = np.array([*(task.reward_scales / task.env.objective_scales), HORIZON_SCALE])
    agent = algorithm(env, **_arguments(task, scaling_factor=scaling))
    # It would write its network into the working directory hundreds of times.
    agent.save = lambda *_, **__: None
    # The return of a cost is at most 0, as in the library's example; otherwise it desires impossible returns.
    high = np.asarray(env.unwrapped.reward_space.high, dtype=np.float32)  # type: ignore[attr-defined]
    max_return = _train(
        task,
        agent,
        max_return=np.where(high <= 0.0, 0.0, UNBOUNDED),
        # It evaluates this many desired returns up to a thousand times, only to log them.
        num_points_pf=1,
    )["max_return"]

    # Desired returns and horizons are those of the non-dominated episodes in the replay buffer.
    returns = np.array([episode[2][0].reward for episode in agent.experience_replay])
    horizons = np.array([len(episode[2]) for episode in agent.experience_replay], dtype=np.float32)
    kept = non_dominated(returns)
    returns, horizons = returns[kept], horizons[kept]

    def choose(rows: NDArray[np.intp], inputs: PolicyInputs) -> Any:
        # It subtracts undiscounted rewards from a discounted return, so the accrued rewards are undiscounted here.
        desired = returns[rows] - inputs.accrued
        desired = np.where(inputs.decisions[:, None] > 0, np.minimum(desired, max_return), desired)
        left = np.maximum(horizons[rows] - inputs.decisions, 1.0)
        outputs = agent.model(task.tensor(inputs.observations), task.tensor(desired), task.tensor(left)[:, None])
        return outputs if agent.continuous_action else _sample(outputs.exp(), inputs.generator)

    names = (*(f"desired_return/{name}" for name in task.env.objectives), "horizon")
    return PeerPolicies(task, choose, np.column_stack([returns * task.reward_scales, horizons]), names)


def envelope(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Envelope Q-learning (Yang et al. 2019)."""
    agent = algorithm(task.make(), **_arguments(task, buffer_size=task.steps))
    _train(task, agent, num_eval_weights_for_front=LOGGED_WEIGHTS)

    def act(observations: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        return torch.einsum("nr,nar->na", weights, agent.q_net(observations, weights)).argmax(-1)

    return _weighted(task, act)


def gpi_ls(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Generalised policy improvement with linear support, discrete or continuous actions (Alegre et al. 2023)."""
    from morl_baselines.multi_policy.linear_support import linear_support

    agent = algorithm(task.make(), **_arguments(task, buffer_size=task.steps))
    with patch.object(linear_support, "policy_evaluation_mo", _evaluated_once(linear_support.policy_evaluation_mo)):
        _train(
            task,
            agent,
            # It trains in whole iterations, and not at all if one is longer than the training.
            timesteps_per_iter=max(1, min(10_000, task.steps // 5)),
            num_eval_episodes_for_front=EVALUATION_EPISODES,
            num_eval_weights_for_front=LOGGED_WEIGHTS,
            checkpoints=False,
        )
    if task.env.continuous and not agent.use_gpi:
        return _weighted(task, agent.policy)

    def act(observations: torch.Tensor, weights: torch.Tensor) -> NDArray[Any]:
        # It does not support batches of observations.
        pairs = zip(observations.cpu().numpy(), weights.cpu().numpy(), strict=True)
        return np.array([agent.eval(observation, weight) for observation, weight in pairs])

    return _weighted(task, act)


def _evaluated_once(evaluate: Callable[..., Any]) -> Callable[..., Any]:
    """``evaluate(agent, env, weight, rep)``, once per weight and number of steps that the agent has made.

    To choose a weight, GPI-LS evaluates all corner weights anew for each corner weight, of which there may be hundreds.
    """
    results: dict[tuple[int, bytes], Any] = {}

    def evaluate_once(agent: Any, env: Any, weight: NDArray[Any], rep: int) -> Any:
        key = agent.global_step, weight.tobytes()
        if key not in results:
            results[key] = evaluate(agent, env, weight, rep=rep)
        return results[key]

    return evaluate_once


def capql(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Concave-augmented Pareto Q-learning (Lu et al. 2023)."""
    agent = algorithm(task.make(), **_arguments(task, buffer_size=task.steps))
    _train(task, agent, num_eval_weights_for_front=LOGGED_WEIGHTS)
    return _weighted(task, agent.policy.get_action)


def morld(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Decomposition into weights, a soft actor-critic for each (Felten et al. 2024)."""
    continuous = task.env.continuous
    options = _arguments(
        task,
        policy_name="MOSAC" if continuous else "MOSACDiscrete",
        # Policies are trained in turns of this many steps; every policy should have at least two turns.
        exchange_every=max(1, min(40_000, task.steps // 12)),
        # It does not pass on the device. It copies all buffers whenever it archives a policy, so they should be small.
        policy_args={"device": task.device, "buffer_size": task.steps, "learning_starts": task.steps // 50},
    )
    agent = algorithm(task.make(), **options)
    _train(task, agent, num_eval_episodes_for_front=EVALUATION_EPISODES, checkpoints=False)

    def act(actor: Any, inputs: PolicyInputs) -> Any:
        observations = task.tensor(inputs.observations)
        if continuous:
            return actor.get_action(observations)[2]
        return _sample(actor(observations).softmax(-1), inputs.generator)

    found = agent.archive.individuals
    acts = [partial(act, policy.wrapped.actor) for policy in found]
    return _networks(task, acts, "weight", [policy.weights for policy in found])


def pgmorl(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Prediction-guided multi-objective reinforcement learning (Xu et al. 2020)."""
    if task.reference_point is None:
        raise ValueError("algorithm 'morl_baselines.pgmorl' maximises hypervolume: set evaluation.reference_point")
    population, num_envs = 6, task.env.num_envs
    # Ten iterations of all policies, half of them warm-up. Between them it chooses weights, which is slow: it fits a
    # model to every policy under every weight. An iteration has to fill 32 minibatches.
    per_iteration = max(-(-32 // num_envs), min(2048, task.steps // (10 * population * num_envs)))
    options = _arguments(
        task,
        # It makes the environments itself from an id; a specification works, too.
        env_id=task.spec(),
        origin=_reference(task),
        num_envs=num_envs,
        pop_size=population,
        steps_per_iteration=per_iteration,
        warmup_iterations=5,
        evolutionary_iterations=5,
    )
    agent = algorithm(**options)
    # Its training environments normalise observations, each with separate statistics; its evaluations would not.
    statistics = agent.env.envs[0].get_wrapper_attr("obs_rms")

    def normalise(observations: NDArray[Any]) -> NDArray[np.float32]:
        normal = (observations - statistics.mean) / np.sqrt(statistics.var + NORMAL_EPSILON)
        return np.asarray(np.clip(normal, -10.0, 10.0), dtype=np.float32)

    env = task.make(recorded=False)
    _train(task, agent, eval_env=gymnasium.wrappers.TransformObservation(env, normalise, env.observation_space))

    def act(policy: Any, inputs: PolicyInputs) -> torch.Tensor:
        mean: torch.Tensor = policy.networks.actor_mean(task.tensor(normalise(inputs.observations)))
        return mean

    found = agent.archive.individuals
    weights = [policy.weights.cpu().numpy() for policy in found]
    return _networks(task, [partial(act, policy) for policy in found], "weight", weights)


def _vector_env(task: PeerTask) -> Any:
    """The training environments as MO-Gymnasium's vector environment."""
    from mo_gymnasium.wrappers.vector import MOSyncVectorEnv

    return MOSyncVectorEnv(iter([lambda index=index: task.make(index) for index in range(task.env.num_envs)]))


def _evaluate_little(agent: Any) -> None:
    """Let an agent evaluate one episode at a time instead of a hundred; `train` has no argument for this."""
    agent.policy_evaluate = partial(agent.policy_evaluate, eval_episodes=EVALUATION_EPISODES)


def ipro(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Iterated Pareto Referent Optimisation (Roepke et al. 2024)."""

    class IPROWithPreferences(algorithm):  # type: ignore[misc]  # the library is not typed
        """Keeps the preference vector of each network, which the network needs as input, in the Pareto set."""

        def linear_train(self, weight_vec: Any, *args: Any, **kwargs: Any) -> Any:
            vector, network = super().linear_train(weight_vec, *args, **kwargs)
            return vector, (network, np.asarray(weight_vec, dtype=np.float32))

        def oracle_train(self, referent: Any, *args: Any, **kwargs: Any) -> Any:
            vector, network = super().oracle_train(referent, *args, **kwargs)
            return vector, (network, np.asarray(referent, dtype=np.float32))

    d, iterations = len(task.env.objectives), int(task.config.arguments.get("max_iterations", 8))
    rounds = 2 * d + iterations  # it starts with the best and the worst value of every objective
    options = _arguments(
        task,
        max_iterations=iterations,
        iter_total_timesteps=task.steps // rounds,
        num_steps=max(1, min(128, task.steps // rounds // task.env.num_envs)),
        # Otherwise all solutions share one network, with the weights of the last round.
        reset_agent=True,
    )
    agent = IPROWithPreferences(_vector_env(task), **options)
    _evaluate_little(agent.agent)
    trained = task.train_arguments(ref_point=_reference(task), deterministic=True)
    solutions = agent.train(task.make(recorded=False), **trained)
    # When it replays its history, it replaces some networks by vectors.
    found = [solution for _, solution in solutions if isinstance(solution, tuple)]

    def act(network: Any, preference: NDArray[np.float32], inputs: PolicyInputs) -> Any:
        state = task.tensor(inputs.observations), task.tensor(inputs.accrued)
        return network.get_greedy_action(*state, task.tensor(preference))

    acts = [partial(act, network, preference) for network, preference in found]
    return _networks(task, acts, "preference", [preference for _, preference in found], gamma=agent.agent.gamma)


def eupg(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Expected utility policy gradient (Roijers et al. 2018)."""
    from morl_baselines.common.accrued_reward_buffer import AccruedRewardReplayBuffer

    # It calls the utility for a NumPy return with weights, and for an episode's torch returns without weights.
    agent = algorithm(task.make(), scalarization=task.utility_of_scaled, **_arguments(task))
    # Its default buffer stores observations as integers.
    agent.buffer = AccruedRewardReplayBuffer(
        obs_shape=agent.observation_shape,
        action_shape=agent.action_shape,
        rew_dim=agent.reward_dim,
        max_size=agent.buffer_size,
        obs_dtype=np.float32,
        action_dtype=np.int32,
    )
    agent.train(task.steps, **task.train_arguments())

    def choose(_rows: NDArray[np.intp], inputs: PolicyInputs) -> torch.Tensor:
        # The network normalises over all observations of the batch, so probabilities are normalised per row here.
        shares = agent.net(task.tensor(inputs.observations), task.tensor(inputs.accrued))
        return _sample(shares / shares.sum(-1, keepdim=True), inputs.generator)

    return PeerPolicies(task, choose)


def nl_mo_ppo(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Proximal policy optimisation of a non-linear utility of the expected return (Roepke et al. 2024)."""
    steps = max(1, min(128, task.steps // task.env.num_envs))
    agent = algorithm(0, _vector_env(task), **_arguments(task, total_timesteps=task.steps, num_steps=steps))
    _evaluate_little(agent)
    agent.train(task.make(recorded=False), u_func=task.utility_of_scaled, **task.train_arguments())

    def choose(_rows: NDArray[np.intp], inputs: PolicyInputs) -> torch.Tensor:
        network = agent.agent
        augmented = network._build_aug_obs(task.tensor(inputs.observations), task.tensor(inputs.accrued), None)
        logits = network.actor(augmented)
        return _sample(logits.softmax(-1), inputs.generator)

    return PeerPolicies(task, choose, gamma=agent.gamma)


def _environments(task: PeerTask, utility: Utility, measure: Any) -> Any:
    """The training environments, with the utility of unscaled rewards as reward."""
    if task.env.native:
        from mo_deepdrive.envs.sb3 import SB3VecEnv

        envs = VectorUtilityReward(RecordedEpisodes(task.env, task.recorder), utility, measure)
        return SB3VecEnv(VectorScaledObservation(envs, task.observation_scales))
    from stable_baselines3.common.vec_env import DummyVecEnv

    return DummyVecEnv(
        [
            lambda index=index: UtilityReward(task.make(index, scaled_rewards=False), utility, measure)
            for index in range(task.env.num_envs)
        ]
    )


def scalar(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Train A2C (Mnih et al. 2016) or PPO (Schulman et al. 2017)."""
    config, utility = task.config, task.utility
    assert isinstance(config, ScalarConfig)
    assert utility is not None
    env = _environments(task, utility, config.utility_of)
    model = algorithm(env=env, **task.arguments(policy="MlpPolicy", verbose=0))
    model.learn(task.steps, **task.train_arguments())
    env.close()

    def choose(_rows: NDArray[np.intp], inputs: PolicyInputs) -> Any:
        # It samples from torch's global generator.
        return model.predict(inputs.observations, deterministic=inputs.generator is None)[0]

    return PeerPolicies(task, choose)
