"""Adapters of morl-baselines: what its algorithms need here, and how the policies that they find act.

Every adapter trains its algorithm in the library's own loop on `PeerEnv` worlds and keeps its defaults, apart from what
stands in the code with the reason. `log=False` throughout: its metrics go to Weights & Biases alone; ours are written
by the recorder.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from algorithms.common.pareto import evenly_spaced_weights, non_dominated
from algorithms.peers.task import Policies, Seen, Task, WeightedConfig

EVALUATION_EPISODES = 1  # of the algorithms' own evaluations during training
# Weights that the algorithms make at the beginning, by a slow optimisation, for evaluations that they only log.
LOGGED_WEIGHTS = 10
# Arguments that YAML gives as lists and the library wants as arrays.
ARRAYS = ("scaling_factor", "max_return", "ref_point", "origin")
HORIZON_SCALE = 0.1  # of PCN's and LCN's horizons, as in the library's examples
UNBOUNDED = 100.0  # where the library itself caps a desired return that has no bound


def _with_arrays(arguments: dict[str, Any]) -> dict[str, Any]:
    return {
        name: np.asarray(value, dtype=np.float32) if name in ARRAYS and value is not None else value
        for name, value in arguments.items()
    }


def _reference(task: Task) -> NDArray[np.float32]:
    """The reference point in the peer's units; zeros where there is none, for peers that only log a hypervolume."""
    if task.reference_point is None:
        return np.zeros(len(task.objectives), dtype=np.float32)
    return (task.reference_point / task.reward_scales).astype(np.float32)


def _sample(probabilities: torch.Tensor, generator: torch.Generator | None) -> NDArray[Any]:
    """Indices (N,) drawn from ``probabilities`` (N, actions), or the most probable ones."""
    if generator is None:
        return probabilities.argmax(-1).cpu().numpy()
    return torch.multinomial(probabilities, 1, generator=generator)[:, 0].cpu().numpy()


def _networks(
    task: Task, acts: Sequence[Callable[[Seen], Any]], prefix: str, vectors: Sequence[Any], gamma: float = 1.0
) -> Policies:
    """Policies that are a network each: ``acts`` gives their actions, ``vectors`` (d,) what each was trained for."""
    shape = (task.env.actions,) if task.env.continuous else ()
    kind = np.float32 if task.env.continuous else np.int64

    def choose(rows: NDArray[np.intp], seen: Seen) -> NDArray[Any]:
        actions = np.zeros((len(rows), *shape), dtype=kind)
        for policy in np.unique(rows):
            mine = rows == policy
            actions[mine] = np.asarray(acts[policy](seen.take(mine)))
        return actions

    # Several networks may have been trained for the same vector: a number tells them apart.
    conditions = np.column_stack([np.arange(len(acts)), np.array(vectors, dtype=np.float64)])
    names = ("network", *(f"{prefix}/{name}" for name in task.objectives))
    return Policies(task, choose, conditions, names, gamma)


def _weighted(task: Task, act: Callable[[torch.Tensor, torch.Tensor], Any]) -> Policies:
    """One network whose policy takes weights: a policy per weight. ``act`` takes (N, o) and (N, d)."""
    config = task.config
    assert isinstance(config, WeightedConfig)
    d = len(task.objectives)
    weights = evenly_spaced_weights(d, max(config.policies, d))

    def choose(rows: NDArray[np.intp], seen: Seen) -> NDArray[Any]:
        return act(task.tensor(seen.observations), task.tensor(weights[rows]))

    return Policies(task, choose, weights, tuple(f"weight/{name}" for name in task.objectives))


def _one_by_one(agent: Any) -> Callable[[torch.Tensor, torch.Tensor], Any]:
    """``agent.eval`` of observations and weights, for algorithms that act for one world at a time."""

    def act(observations: torch.Tensor, weights: torch.Tensor) -> NDArray[Any]:
        pairs = zip(observations.cpu().numpy(), weights.cpu().numpy(), strict=True)
        return np.array([agent.eval(observation, weight) for observation, weight in pairs])

    return act


# ------------------------------------------------------------------------------------------- conditioned on commands


def pcn(task: Task) -> Policies:
    """Pareto Conditioned Networks (Reymond et al. 2022)."""
    from morl_baselines.multi_policy.pcn.pcn import PCN

    return _commanded(task, PCN)


def lcn(task: Task) -> Policies:
    """Lorenz Conditioned Networks (Michailidis et al. 2026)."""
    from morl_baselines.multi_policy.lcn.lcn import LCN

    return _commanded(task, LCN)


def _commanded(task: Task, algorithm: Any) -> Policies:
    env = task.make()
    scaling = np.array([*(task.reward_scales / task.env.objective_scales), HORIZON_SCALE])
    options = task.arguments(
        scaling_factor=scaling, gamma=task.config.gamma, seed=task.seed, device=task.device, log=False
    )
    agent = algorithm(env, **_with_arrays(options))
    # It would write its network to the working directory hundreds of times.
    agent.save = lambda *_, **__: None
    # A cost's return to go is at most 0, as in the library's example; without that it asks for the impossible.
    high = np.asarray(env.unwrapped.reward_space.high, dtype=np.float32)  # type: ignore[attr-defined]
    trained = task.train_arguments(
        max_return=np.where(high <= 0.0, 0.0, UNBOUNDED).astype(np.float32),
        # It evaluates that many commands up to a thousand times, only to log them.
        num_points_pf=1,
        ref_point=_reference(task),
    )
    trained = _with_arrays(trained)
    agent.train(total_timesteps=task.steps, eval_env=task.make(recorded=False), **trained)

    # The commands: what the non-dominated episodes that it keeps got, in how many decisions.
    returns = np.array([episode[2][0].reward for episode in agent.experience_replay])
    horizons = np.array([len(episode[2]) for episode in agent.experience_replay], dtype=np.float32)
    kept = non_dominated(returns)
    returns, horizons = returns[kept], horizons[kept]
    most = trained["max_return"]

    def choose(rows: NDArray[np.intp], seen: Seen) -> NDArray[Any]:
        # It takes undiscounted rewards off a discounted return, so the accrued ones here are undiscounted too.
        desired = returns[rows] - seen.accrued
        desired = np.where(seen.decisions[:, None] > 0, np.minimum(desired, most), desired)
        left = np.maximum(horizons[rows] - seen.decisions, 1.0)
        outputs = agent.model(task.tensor(seen.observations), task.tensor(desired), task.tensor(left)[:, None])
        if agent.continuous_action:
            return outputs.cpu().numpy()
        return _sample(outputs.exp(), seen.generator)

    names = (*(f"desired_return/{name}" for name in task.objectives), "horizon")
    return Policies(task, choose, np.column_stack([returns * task.reward_scales, horizons]), names)


# -------------------------------------------------------------------------------------------- conditioned on weights


def envelope(task: Task) -> Policies:
    """Envelope Q-learning (Yang et al. 2019)."""
    from morl_baselines.multi_policy.envelope.envelope import Envelope

    options = task.arguments(
        gamma=task.config.gamma, seed=task.seed, device=task.device, log=False, buffer_size=task.steps
    )
    agent = Envelope(task.make(), **options)
    trained = task.train_arguments(num_eval_weights_for_front=LOGGED_WEIGHTS)
    agent.train(task.steps, **_with_arrays(trained))

    def act(observations: torch.Tensor, weights: torch.Tensor) -> NDArray[Any]:
        values = agent.q_net(observations, weights)
        return torch.einsum("nr,nar->na", weights, values).argmax(-1).cpu().numpy()

    return _weighted(task, act)


def gpi_ls(task: Task) -> Policies:
    """Generalised policy improvement with linear support, discrete actions (Alegre et al. 2023)."""
    from morl_baselines.multi_policy.gpi_pd.gpi_pd import GPILS

    return _gpi(task, GPILS)


def gpi_ls_continuous(task: Task) -> Policies:
    """Generalised policy improvement with linear support, continuous actions (Alegre et al. 2023)."""
    from morl_baselines.multi_policy.gpi_pd.gpi_pd_continuous_action import GPILSContinuousAction

    return _gpi(task, GPILSContinuousAction)


def _gpi(task: Task, algorithm: Any) -> Policies:
    options = task.arguments(
        gamma=task.config.gamma, seed=task.seed, device=task.device, log=False, buffer_size=task.steps
    )
    agent = algorithm(task.make(), **options)
    trained = task.train_arguments(
        ref_point=_reference(task),
        # It trains in whole iterations, and not at all where one is longer than the training.
        timesteps_per_iter=max(1, min(10_000, task.steps // 5)),
        # Every choice of a weight evaluates every corner of the weights once per corner.
        num_eval_episodes_for_front=EVALUATION_EPISODES,
        num_eval_weights_for_front=LOGGED_WEIGHTS,
        checkpoints=False,
    )
    agent.train(task.steps, eval_env=task.make(recorded=False), **_with_arrays(trained))
    return _weighted(task, _one_by_one(agent))


def capql(task: Task) -> Policies:
    """Concave-augmented Pareto Q-learning (Lu et al. 2023)."""
    from morl_baselines.multi_policy.capql.capql import CAPQL

    options = task.arguments(
        gamma=task.config.gamma, seed=task.seed, device=task.device, log=False, buffer_size=task.steps
    )
    agent = CAPQL(task.make(), **options)
    trained = task.train_arguments(ref_point=_reference(task), num_eval_weights_for_front=LOGGED_WEIGHTS)
    agent.train(task.steps, eval_env=task.make(recorded=False), **_with_arrays(trained))

    def act(observations: torch.Tensor, weights: torch.Tensor) -> NDArray[Any]:
        return agent.policy.get_action(observations, weights).cpu().numpy()

    return _weighted(task, act)


# ------------------------------------------------------------------------------------------------- a network per policy


def morld(task: Task) -> Policies:
    """Decomposition into weights, a soft actor-critic for each (Felten et al. 2024)."""
    from morl_baselines.multi_policy.morld.morld import MORLD

    continuous = task.env.continuous
    options = task.arguments(
        policy_name="MOSAC" if continuous else "MOSACDiscrete",
        gamma=task.config.gamma,
        seed=task.seed,
        device=task.device,
        log=False,
        # It takes turns after this many steps; every policy shall have two turns at least.
        exchange_every=max(1, min(40_000, task.steps // 12)),
        # It hands no device on. It copies the buffers of all policies with every archived one: no larger than needed.
        policy_args={"device": task.device, "buffer_size": task.steps, "learning_starts": task.steps // 50},
    )
    agent = MORLD(task.make(), **options)
    trained = task.train_arguments(
        ref_point=_reference(task), num_eval_episodes_for_front=EVALUATION_EPISODES, checkpoints=False
    )
    agent.train(task.steps, eval_env=task.make(recorded=False), **_with_arrays(trained))

    def act(policy: Any) -> Callable[[Seen], Any]:
        actor = policy.wrapped.actor
        if continuous:
            return lambda seen: actor.get_action(task.tensor(seen.observations))[2].cpu().numpy()
        return lambda seen: _sample(actor(task.tensor(seen.observations)).softmax(-1), seen.generator)

    found = agent.archive.individuals
    return _networks(task, [act(policy) for policy in found], "weight", [policy.weights for policy in found])


class _Normalised(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Observations by the running statistics of ``source``, a NormalizeObservation wrapper, clipped as PGMORL does."""

    def __init__(self, env: gymnasium.Env[Any, Any], source: Any):
        super().__init__(env)
        self._source = source

    def observation(self, observation: Any) -> Any:
        return _normalise(observation, self._source)


def _normalise(observations: NDArray[Any], source: Any) -> NDArray[np.float32]:
    statistics = source.obs_rms
    normal = (observations - statistics.mean) / np.sqrt(statistics.var + source.epsilon)
    return np.clip(normal, -10.0, 10.0).astype(np.float32)


def _find_wrapper(env: Any, kind: type) -> Any:
    while not isinstance(env, kind):
        env = env.env
    return env


def pgmorl(task: Task) -> Policies:
    """Prediction-guided multi-objective reinforcement learning (Xu et al. 2020)."""
    from gymnasium.wrappers import NormalizeObservation
    from morl_baselines.multi_policy.pgmorl.pgmorl import PGMORL

    if task.reference_point is None:
        raise ValueError("algorithm 'morl_baselines.pgmorl' needs evaluation.reference_point: it steers by it")
    population, worlds = 6, task.num_envs
    # Ten iterations of all policies, half of them warm-up, and one choice of weights between: a choice fits a model
    # to every policy under every weight. An iteration fills the 32 minibatches at least.
    per_iteration = max(-(-32 // worlds), min(2048, task.steps // (10 * population * worlds)))
    options = task.arguments(
        # It takes an id and makes its worlds itself; a specification that Gymnasium makes does as well.
        env_id=task.spec(),
        origin=_reference(task),
        num_envs=worlds,
        pop_size=population,
        steps_per_iteration=per_iteration,
        warmup_iterations=5,
        evolutionary_iterations=5,
        gamma=task.config.gamma,
        seed=task.seed,
        device=task.device,
        log=False,
    )
    agent = PGMORL(**_with_arrays(options))
    # Its training worlds normalise observations, each by its own statistics; its evaluations would not.
    source = _find_wrapper(agent.env.envs[0], NormalizeObservation)
    trained = task.train_arguments(ref_point=_reference(task))
    agent.train(task.steps, eval_env=_Normalised(task.make(recorded=False), source), **_with_arrays(trained))

    def act(policy: Any) -> Callable[[Seen], Any]:
        return lambda seen: policy.networks.actor_mean(task.tensor(_normalise(seen.observations, source))).cpu().numpy()

    found = agent.archive.individuals
    weights = [policy.weights.cpu().numpy() for policy in found]
    return _networks(task, [act(policy) for policy in found], "weight", weights)


def _vector_env(task: Task) -> Any:
    from mo_gymnasium.wrappers.vector import MOSyncVectorEnv

    return MOSyncVectorEnv(iter([lambda index=index: task.make(index) for index in range(task.num_envs)]))


def ipro(task: Task) -> Policies:
    """Iterated Pareto Referent Optimisation (Roepke et al. 2024)."""
    from morl_baselines.multi_policy.ipro.ipro import IPRO

    class Remembering(IPRO):
        """Its Pareto set holds networks without the preference vector that each was trained with and takes."""

        def linear_train(self, weight_vec: Any, *args: Any, **kwargs: Any) -> Any:
            vector, network = super().linear_train(weight_vec, *args, **kwargs)
            return vector, (network, np.asarray(weight_vec, dtype=np.float32))

        def oracle_train(self, referent: Any, *args: Any, **kwargs: Any) -> Any:
            vector, network = super().oracle_train(referent, *args, **kwargs)
            return vector, (network, np.asarray(referent, dtype=np.float32))

    d, iterations = len(task.objectives), int(task.config.arguments.get("max_iterations", 8))
    rounds = 2 * d + iterations  # the best and the worst of every objective come first
    options = task.arguments(
        max_iterations=iterations,
        iter_total_timesteps=task.steps // rounds,
        num_steps=max(1, min(128, task.steps // rounds // task.num_envs)),
        # Otherwise all solutions are the same network, as the last round left it.
        reset_agent=True,
        gamma=task.config.gamma,
        seed=task.seed,
        device=task.device,
        log=False,
    )
    agent = Remembering(_vector_env(task), **options)
    evaluate = agent.agent.policy_evaluate
    # A hundred episodes after every round are its default, and no argument of `train`.
    agent.agent.policy_evaluate = lambda env, eval_episodes=EVALUATION_EPISODES, **rest: evaluate(
        env, eval_episodes, **rest
    )
    trained = task.train_arguments(ref_point=_reference(task), deterministic=True)
    solutions = agent.train(task.make(recorded=False), **_with_arrays(trained))
    # Where it replays its history it puts a vector in the place of some networks.
    found = [solution for _, solution in solutions if isinstance(solution, tuple)]

    def act(network: Any, preference: NDArray[np.float32]) -> Callable[[Seen], Any]:
        return lambda seen: (
            network.get_greedy_action(
                task.tensor(seen.observations), task.tensor(seen.accrued), task.tensor(preference)
            )
            .cpu()
            .numpy()
        )

    acts = [act(network, preference) for network, preference in found]
    return _networks(task, acts, "preference", [preference for _, preference in found], gamma=agent.agent.gamma)


# ------------------------------------------------------------------------------------------------------ known utility


def eupg(task: Task) -> Policies:
    """Expected utility policy gradient (Roijers et al. 2018)."""
    from morl_baselines.common.accrued_reward_buffer import AccruedRewardReplayBuffer
    from morl_baselines.single_policy.esr.eupg import EUPG

    options = task.arguments(gamma=task.config.gamma, seed=task.seed, device=task.device, log=False)
    # It scalarises one return as NumPy with weights and an episode's returns to go as torch without.
    agent = EUPG(task.make(), scalarization=task.utility_of_scaled, **options)
    # Its own buffer keeps observations as integers.
    agent.buffer = AccruedRewardReplayBuffer(
        obs_shape=agent.observation_shape,
        action_shape=agent.action_shape,
        rew_dim=agent.reward_dim,
        max_size=agent.buffer_size,
        obs_dtype=np.float32,
        action_dtype=np.int32,
    )
    agent.train(task.steps, **task.train_arguments())

    def choose(rows: NDArray[np.intp], seen: Seen) -> NDArray[Any]:
        # The network divides by the sum over all observations that it is given; a distribution divides again.
        shares = agent.net(task.tensor(seen.observations), task.tensor(seen.accrued))
        return _sample(shares / shares.sum(-1, keepdim=True), seen.generator)

    return Policies(task, choose)


def nl_mo_ppo(task: Task) -> Policies:
    """Proximal policy optimisation of a non-linear utility of the expected return (Roepke et al. 2024)."""
    from morl_baselines.single_policy.ser.nl_mo_ppo import NLMOPPO

    options = task.arguments(
        total_timesteps=task.steps,
        num_steps=max(1, min(128, task.steps // task.num_envs)),
        gamma=task.config.gamma,
        seed=task.seed,
        device=task.device,
        log=False,
    )
    agent = NLMOPPO(0, _vector_env(task), **options)
    evaluate = agent.policy_evaluate
    # As for IPRO: its evaluation at the end is not what is reported here.
    agent.policy_evaluate = lambda env, eval_episodes=EVALUATION_EPISODES, **rest: evaluate(env, eval_episodes, **rest)
    agent.train(task.make(recorded=False), u_func=task.utility_of_scaled, **task.train_arguments())

    def choose(rows: NDArray[np.intp], seen: Seen) -> NDArray[Any]:
        network, inputs = agent.agent, (task.tensor(seen.observations), task.tensor(seen.accrued))
        logits = network.actor(network._build_aug_obs(*inputs, None))
        return _sample(logits.softmax(-1), seen.generator)

    return Policies(task, choose, gamma=agent.gamma)
