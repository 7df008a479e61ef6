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

EVALUATION_EPISODES = 1  # of the algorithms' own evaluations during training, which are not reported
LOGGED_WEIGHTS = 10  # for evaluations that the algorithms only log; computing them at the start is slow


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
    task: PeerTask, act: Callable[..., Any], networks: Sequence[tuple[Any, Any]], prefix: str, gamma: float = 1.0
) -> PeerPolicies:
    """One policy per network and the vector (d,) that it was trained for; ``act(network, vector, inputs)`` acts.

    ``gamma`` is the discount of the accrued rewards in the inputs, ``prefix`` that of the names of the conditions.
    """
    shape, kind = ((task.env.actions,), np.float32) if task.env.continuous else ((), np.int64)

    def choose(rows: NDArray[np.intp], inputs: PolicyInputs) -> NDArray[Any]:
        actions: NDArray[Any] = np.zeros((len(rows), *shape), dtype=kind)
        for policy in np.unique(rows):
            mine = rows == policy
            observations, accrued, decisions = (each[mine] for each in inputs[:3])
            part = PolicyInputs(observations, accrued, decisions, inputs.generator)
            actions[mine] = as_array(act(*networks[policy], part))
        return actions

    # Several networks may have been trained for the same vector, so conditions start with a number.
    vectors = np.array([vector for _, vector in networks], dtype=np.float64)
    names = ("network", *(f"{prefix}/{name}" for name in task.env.objectives))
    return PeerPolicies(task, choose, np.column_stack([np.arange(len(networks)), vectors]), names, gamma)


def _weighted(task: PeerTask, act: Callable[[torch.Tensor, torch.Tensor], Any]) -> PeerPolicies:
    """One policy per weight vector of a network that takes weights; ``act`` takes (N, o) and (N, d)."""
    assert isinstance(task.config, WeightedConfig)
    d = len(task.env.objectives)
    weights = evenly_spaced_weights(d, max(task.config.policies, d))

    def choose(rows: NDArray[np.intp], inputs: PolicyInputs) -> Any:
        return act(task.tensor(inputs.observations), task.tensor(weights[rows]))

    return PeerPolicies(task, choose, weights, tuple(f"weight/{name}" for name in task.env.objectives))


def conditioned_on_returns(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Pareto Conditioned Networks (Reymond et al. 2022) and Lorenz Conditioned Networks (Michailidis et al. 2026).

    There is one policy per non-dominated episode in the replay buffer.
    """
    env = task.make()
    # Horizons are scaled as in the library's examples.
    scaling = np.array([*(task.reward_scales / task.env.objective_scales), 0.1])
    agent = algorithm(env, **_arguments(task, scaling_factor=scaling))
    # It would write its network into the working directory hundreds of times.
    agent.save = lambda *_, **__: None
    # The return of a cost is at most 0, as in the library's example; otherwise it desires impossible returns. 100 is
    # the library's own limit. It evaluates its desired returns up to a thousand times, only to log them: 1 is enough.
    high = np.asarray(env.unwrapped.reward_space.high, dtype=np.float32)  # type: ignore[attr-defined]
    limits = np.where(high <= 0.0, 0.0, 100.0)
    max_return = _train(task, agent, max_return=limits, num_points_pf=1)["max_return"]

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
    """Generalised policy improvement with linear support, discrete or continuous actions (Alegre et al. 2023).

    To choose a weight, it evaluates all corner weights anew for each corner weight, of which there may be hundreds;
    here once per weight and number of steps that the agent has made.
    """
    from morl_baselines.multi_policy.linear_support import linear_support

    agent = algorithm(task.make(), **_arguments(task, buffer_size=task.steps))
    evaluate, results = linear_support.policy_evaluation_mo, {}

    def evaluate_once(agent: Any, env: Any, weight: NDArray[Any], rep: int) -> Any:
        key = agent.global_step, weight.tobytes()
        if key not in results:
            results[key] = evaluate(agent, env, weight, rep=rep)
        return results[key]

    with patch.object(linear_support, "policy_evaluation_mo", evaluate_once):
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

    def act(actor: Any, _weights: Any, inputs: PolicyInputs) -> Any:
        observations = task.tensor(inputs.observations)
        if continuous:
            return actor.get_action(observations)[2]
        return _sample(actor(observations).softmax(-1), inputs.generator)

    networks = [(policy.wrapped.actor, policy.weights) for policy in agent.archive.individuals]
    return _networks(task, act, networks, "weight")


def pgmorl(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Prediction-guided multi-objective reinforcement learning (Xu et al. 2020)."""
    if task.reference_point is None:
        raise ValueError("algorithm 'morl_baselines.pgmorl' maximises hypervolume: set evaluation.reference_point")
    population, num_envs = 6, task.env.num_envs
    # Ten iterations of all policies, half of them warm-up. Between them it chooses weights, which is slow: it fits a
    # model to every policy under every weight. An iteration has to fill 32 minibatches.
    per_iteration = max(-(-32 // num_envs), min(2048, task.steps // (10 * population * num_envs)))
    agent = algorithm(
        **_arguments(
            task,
            env_id=task.spec(),  # it makes the environments itself from an id; a specification works, too
            origin=_reference(task),
            num_envs=num_envs,
            pop_size=population,
            steps_per_iteration=per_iteration,
            warmup_iterations=5,
            evolutionary_iterations=5,
        )
    )
    # Its training environments normalise observations, each with separate statistics; its evaluations would not.
    statistics = agent.env.envs[0].get_wrapper_attr("obs_rms")

    def normalise(observations: NDArray[Any]) -> NDArray[np.float32]:
        normal = (observations - statistics.mean) / np.sqrt(statistics.var + 1e-8)  # as Gymnasium
        return np.asarray(np.clip(normal, -10.0, 10.0), dtype=np.float32)

    env = task.make(recorded=False)
    _train(task, agent, eval_env=gymnasium.wrappers.TransformObservation(env, normalise, env.observation_space))

    def act(networks: Any, _weights: Any, inputs: PolicyInputs) -> Any:
        return networks.actor_mean(task.tensor(normalise(inputs.observations)))

    networks = [(policy.networks, policy.weights.cpu().numpy()) for policy in agent.archive.individuals]
    return _networks(task, act, networks, "weight")


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

    iterations = int(task.config.arguments.get("max_iterations", 8))
    # It starts with the best and the worst value of every objective.
    steps = task.steps // (2 * len(task.env.objectives) + iterations)
    options = _arguments(
        task,
        max_iterations=iterations,
        iter_total_timesteps=steps,
        num_steps=max(1, min(128, steps // task.env.num_envs)),
        # Otherwise all solutions share one network, with the weights of the last round.
        reset_agent=True,
    )
    agent = IPROWithPreferences(_vector_env(task), **options)
    _evaluate_little(agent.agent)
    trained = task.train_arguments(ref_point=_reference(task), deterministic=True)
    solutions = agent.train(task.make(recorded=False), **trained)
    # When it replays its history, it replaces some networks by vectors.
    networks = [solution for _, solution in solutions if isinstance(solution, tuple)]

    def act(network: Any, preference: NDArray[np.float32], inputs: PolicyInputs) -> Any:
        return network.get_greedy_action(*map(task.tensor, (inputs.observations, inputs.accrued, preference)))

    return _networks(task, act, networks, "preference", gamma=agent.agent.gamma)


def eupg(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Expected utility policy gradient (Roijers et al. 2018)."""
    from morl_baselines.common.accrued_reward_buffer import AccruedRewardReplayBuffer

    # It calls the utility for a NumPy return with weights, and for an episode's torch returns without weights.
    agent = algorithm(task.make(), scalarization=task.utility_of_scaled, **_arguments(task))
    # Its default buffer stores observations as integers.
    shapes = {"obs_shape": agent.observation_shape, "action_shape": agent.action_shape, "rew_dim": agent.reward_dim}
    kinds = {"obs_dtype": np.float32, "action_dtype": np.int32}
    agent.buffer = AccruedRewardReplayBuffer(**shapes, **kinds, max_size=agent.buffer_size)
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
        return _sample(network.actor(augmented).softmax(-1), inputs.generator)

    return PeerPolicies(task, choose, gamma=agent.gamma)


def scalar(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """A2C (Mnih et al. 2016) or PPO (Schulman et al. 2017), whose reward is the utility of unscaled rewards."""
    assert isinstance(task.config, ScalarConfig)
    assert task.utility is not None
    env: Any
    judged = task.utility, task.config.utility_of
    if task.env.native:
        from mo_deepdrive.envs.sb3 import SB3VecEnv

        envs = VectorUtilityReward(RecordedEpisodes(task.env, task.recorder), *judged)
        env = SB3VecEnv(VectorScaledObservation(envs, task.observation_scales))
    else:
        from stable_baselines3.common.vec_env import DummyVecEnv

        makers = [partial(task.make, index, scaled_rewards=False) for index in range(task.env.num_envs)]
        env = DummyVecEnv([lambda make=make: UtilityReward(make(), *judged) for make in makers])
    model = algorithm(env=env, **task.arguments(policy="MlpPolicy", verbose=0))
    model.learn(task.steps, **task.train_arguments())
    env.close()

    def choose(_rows: NDArray[np.intp], inputs: PolicyInputs) -> Any:
        # It samples from torch's global generator.
        return model.predict(inputs.observations, deterministic=inputs.generator is None)[0]

    return PeerPolicies(task, choose)
