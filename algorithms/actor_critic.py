"""The actor-critic agent: one independent learner per vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from algorithms.agent import Agent, EvaluationPlan
from algorithms.common.accrued_reward import AccruedReward
from algorithms.common.checkpoints import below
from algorithms.common.rollout import Collector, Episodes, Rollout
from algorithms.evaluation.evaluate import evaluate
from algorithms.learner import ActorCriticConfig, Learner
from mo_deepdrive.utilities import Utility


class ActorCritic(Agent):
    """Base of the actor-critic agents: one independent learner per vehicle.

    Args:
        env: a vector environment with vector rewards, from `algorithms.common.env_adapter.make_env`.
        utility: the known utility, or one per vehicle.
        seed: determines the run, bit for bit on one machine.
        device: where the networks live.
        **hyperparameters: fields of the class's Config.

    Raises:
        ValueError: for unknown or unfit hyperparameters, spaces or utilities.
    """

    Config: ClassVar[type[ActorCriticConfig]]
    learner: ClassVar[type[Learner]]
    known_utility = True

    def __init__(
        self,
        env: VectorEnv,
        utility: Utility | Sequence[Utility],
        *,
        seed: int = 0,
        device: str = "cpu",
        **hyperparameters: Any,
    ):
        super().__init__(env, seed=seed, device=device, hyperparameters=hyperparameters)
        utilities = [utility] * self.env.vehicles if isinstance(utility, Utility) else list(utility)
        if len(utilities) != self.env.vehicles:
            raise ValueError(f"{len(utilities)} utilities for {self.env.vehicles} vehicles")
        for each in utilities:
            if len(each.objectives) != len(self.env.objectives):
                raise ValueError(
                    f"utility {each.name!r} reads {each.objectives}; the environment emits {self.env.objectives}"
                )
            if self.env.native and each.objectives != self.env.objectives:
                raise ValueError(
                    f"utility {each.name!r} reads {each.objectives} in this order; "
                    f"the environment emits {self.env.objectives}"
                )
        self.utilities = utilities
        self.learners = [
            self.learner(self.env, v, each, self.config, self._initial, self.device) for v, each in enumerate(utilities)
        ]
        self.collector = Collector(self.env, self.config.accrual, self.config.steps)
        self._unlogged: list[Episodes] = []

    @property
    def gamma(self) -> float:
        """Discount of the accrued reward."""
        return float(self.config.accrual)

    @property
    def updates(self) -> int:
        """Updates made so far."""
        return self.step // (self.config.steps * self.env.num_envs)

    @torch.inference_mode()
    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o) in episodes that have come to ``accrued_reward``.

        ``generator`` None acts greedily.
        """
        chosen = []
        for v, learner in enumerate(self.learners):
            x = learner.inputs(
                torch.from_numpy(observations[:, v]).to(self.device),
                torch.from_numpy(accrued_reward.value[:, v]).to(self.device),
                torch.from_numpy(accrued_reward.discounts[:, v]).to(self.device),
            )
            action = learner.actor.greedy(x) if generator is None else learner.actor.sample(x, generator)
            chosen.append(action.cpu().numpy())
        return chosen[0][:, None] if len(chosen) == 1 else np.stack(chosen, axis=1)

    def eval(self, obs: NDArray[Any], accrued_reward: NDArray[Any] | None = None, discount: float = 1.0) -> Any:
        """The greedy action for one observation, as in morl-baselines.

        Args:
            obs: as one environment gives it; (V, o) with several vehicles.
            accrued_reward: (d,) or (V, d) discounted sum of the episode's rewards so far; zeros if None.
            discount: gamma^t.

        Returns:
            An action as the environment takes it; one per vehicle with several.
        """
        so_far = AccruedReward.begin(1, self.env.vehicles, len(self.env.objectives))
        if accrued_reward is not None:
            so_far.value[:] = np.reshape(accrued_reward, so_far.value.shape)
        so_far.discounts[:] = discount
        observations = self.env.policy_observations(np.asarray(obs)[None]).astype(np.float32)
        return self.env.environment_actions(self.act(observations, so_far, None))[0]

    def _explore(self, observations: NDArray[np.float32], accrued_reward: AccruedReward) -> NDArray[Any]:
        return self.act(observations, accrued_reward, self.generator)

    def _begin(self) -> None:
        self.collector.reset(self._worlds_seed)

    def _update(self, progress: float) -> dict[str, float]:
        rollout, episodes = self.collector.collect(self._explore)
        self.step += self.config.steps * self.env.num_envs
        return self._learn(rollout, episodes, progress)

    def _learn(self, rollout: Rollout, episodes: Episodes, progress: float) -> dict[str, float]:
        learning_rate = self.config.learning_rate_at(progress)
        entropy_weight = self.config.entropy_at(progress)
        metrics: dict[str, float] = {"policy/learning_rate": learning_rate, "policy/entropy_weight": entropy_weight}
        self._unlogged.append(episodes)
        for v, learner in enumerate(self.learners):
            learner.finished(episodes.discounted[episodes.vehicles == v])
            losses = learner.update(rollout, learning_rate, entropy_weight)
            prefix = f"vehicle_{v}/" if len(self.learners) > 1 else ""
            metrics |= {prefix + name: value for name, value in losses.items()}
        return metrics

    def _training_metrics(self) -> dict[str, float]:
        """Means over the episodes that ended since the last line of the log."""
        metrics: dict[str, float] = {}
        for v, utility in enumerate(self.utilities):
            prefix = f"train/vehicle_{v}/" if len(self.utilities) > 1 else "train/"
            parts = [(e, e.vehicles == v) for e in self._unlogged]
            returns = np.concatenate([e.returns[mine] for e, mine in parts])
            if not len(returns):
                continue
            metrics[prefix + "utility"] = float(np.mean(utility(returns)))
            metrics[prefix + "success"] = float(np.mean(np.concatenate([e.succeeded[mine] for e, mine in parts])))
            metrics[prefix + "length"] = float(np.mean(np.concatenate([e.lengths[mine] for e, mine in parts])))
            for objective, mean in zip(self.env.objectives, returns.mean(axis=0), strict=True):
                metrics[f"{prefix}return/{objective}"] = float(mean)
        self._unlogged = []
        return metrics

    def _forget(self) -> None:
        self._unlogged.clear()

    def _evaluate(self, plan: EvaluationPlan) -> tuple[dict[str, float], None]:
        metrics: dict[str, float] = {}
        for policy in ("greedy", "stochastic"):
            result = evaluate(
                self,
                plan.env,
                episodes=plan.episodes,
                seed=plan.seed,
                greedy=policy == "greedy",
                gamma=plan.gamma,
            )
            metrics |= {f"eval/{policy}/{name}": value for name, value in result.metrics().items()}
        return metrics, None

    def _get_state(self) -> dict[str, torch.Tensor]:
        tensors = self._tensors()
        for name in ("vehicles", "returns", "discounted", "lengths", "succeeded"):
            arrays = [getattr(episodes, name) for episodes in self._unlogged]
            if arrays:
                tensors[f"unlogged.{name}"] = torch.from_numpy(np.concatenate(arrays))
        return tensors

    def _tensors(self) -> dict[str, torch.Tensor]:
        """Everything that determines the future, apart from episodes that wait for the log."""
        tensors: dict[str, torch.Tensor] = {"generator": self.generator.get_state()}
        for v, learner in enumerate(self.learners):
            tensors |= {f"vehicle_{v}.{name}": tensor for name, tensor in learner.get_state().items()}
        for name, array in self.collector.get_state().items():
            tensors[f"collector.{name}"] = torch.from_numpy(np.ascontiguousarray(array))
        return tensors

    def _identity(self) -> dict[str, Any]:
        return {
            **super()._identity(),
            "centralised_critic": self.config.centralised_critic,
            "inputs": self.learners[0].input_size(self.env),
        }

    def _get_policy(self) -> dict[str, torch.Tensor]:
        return {
            f"vehicle_{v}.{name}": tensor
            for v, learner in enumerate(self.learners)
            for name, tensor in learner.get_policy().items()
        }

    def _shapes(self, policy_only: bool) -> dict[str, tuple[int, ...]]:
        needed = self._get_policy() if policy_only else self._tensors()
        return {name: tuple(tensor.shape) for name, tensor in needed.items()}

    def _set_policy(self, tensors: dict[str, torch.Tensor]) -> None:
        for v, learner in enumerate(self.learners):
            learner.set_policy(below(tensors, f"vehicle_{v}."))

    def _set_state(self, tensors: dict[str, torch.Tensor]) -> None:
        for v, learner in enumerate(self.learners):
            learner.set_state(below(tensors, f"vehicle_{v}."))
        self.generator.set_state(tensors["generator"])
        self.collector.set_state({name: t.numpy() for name, t in below(tensors, "collector.").items()})
        unlogged = {name: t.numpy() for name, t in below(tensors, "unlogged.").items()}
        self._unlogged = [Episodes(**unlogged)] if unlogged else []

    def _resumed(self) -> None:
        if not self.env.native:
            # Other environments cannot give their state: their episodes begin anew, on other seeds.
            self.collector.reset(self._worlds_seed + self.step)
