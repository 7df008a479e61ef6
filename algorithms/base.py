"""The agent: one independent learner per vehicle, the training loop, acting, evaluation and checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from algorithms.checkpoints import below, read_checkpoint, write_checkpoint
from algorithms.evaluation import evaluate
from algorithms.learner import ActorCriticConfig, Learner
from algorithms.rollout import Collector, Episodes, Rollout
from algorithms.worlds import Worlds
from mo_deepdrive.config import parse
from mo_deepdrive.utilities import Utility

# Worlds are trained on seeds from here on; evaluation uses smaller ones.
FIRST_TRAINING_SEED = 2**32
EVALUATION_INTERVALS = 20

Log = Callable[[int, dict[str, float]], None]


class ActorCritic:
    """Base of the actor-critic agents: one independent learner per vehicle.

    Args:
        env: a vector environment with vector rewards, from `algorithms.worlds.make_env`.
        utility: the known utility, or one per vehicle.
        seed: determines the run, bit for bit on one machine.
        device: where the networks live.
        **hyperparameters: fields of the class's Config.

    Raises:
        ValueError: for unknown or unfit hyperparameters, spaces or utilities.
    """

    name: ClassVar[str]
    Config: ClassVar[type[ActorCriticConfig]]
    learner: ClassVar[type[Learner]]

    def __init__(
        self,
        env: VectorEnv,
        utility: Utility | Sequence[Utility],
        *,
        seed: int = 0,
        device: str = "cpu",
        **hyperparameters: Any,
    ):
        self.config = parse(self.Config, hyperparameters, f"hyperparameters of {self.name}")
        self.worlds = Worlds(env)
        self.seed = seed
        self.device = torch.device(device)
        utilities = [utility] * self.worlds.vehicles if isinstance(utility, Utility) else list(utility)
        if len(utilities) != self.worlds.vehicles:
            raise ValueError(f"{len(utilities)} utilities for {self.worlds.vehicles} vehicles")
        for each in utilities:
            if len(each.objectives) != len(self.worlds.objectives):
                raise ValueError(
                    f"utility {each.name!r} reads {each.objectives}; the environment emits {self.worlds.objectives}"
                )
            if self.worlds.native and each.objectives != self.worlds.objectives:
                raise ValueError(
                    f"utility {each.name!r} reads {each.objectives} in this order; "
                    f"the environment emits {self.worlds.objectives}"
                )
        self.utilities = utilities
        weights_seed, actions_seed, worlds_seed = np.random.SeedSequence(seed).generate_state(3)
        initial = torch.Generator().manual_seed(int(weights_seed))
        self.learners = [
            self.learner(self.worlds, v, each, self.config, initial, self.device) for v, each in enumerate(utilities)
        ]
        self.generator = torch.Generator(self.device).manual_seed(int(actions_seed))
        self._worlds_seed = FIRST_TRAINING_SEED + int(worlds_seed)
        self.collector = Collector(self.worlds, self.config.gamma, self.config.steps)
        self.step = 0
        self._unlogged: list[Episodes] = []

    def get_config(self) -> dict[str, Any]:
        """The resolved hyperparameters, for logs."""
        return {"algorithm": self.name, "seed": self.seed, **self.config.model_dump()}

    @torch.inference_mode()
    def act(
        self,
        observations: NDArray[np.float32],
        accrued: NDArray[np.float32],
        discounts: NDArray[np.float32],
        generator: torch.Generator | None,
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o), accrued rewards (N, V, d) and discounts (N, V).

        ``generator`` None acts greedily.
        """
        chosen = []
        for v, learner in enumerate(self.learners):
            x = learner.inputs(
                torch.from_numpy(observations[:, v]).to(self.device),
                torch.from_numpy(accrued[:, v]).to(self.device),
                torch.from_numpy(discounts[:, v]).to(self.device),
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
        v = self.worlds.vehicles
        d = len(self.worlds.objectives)
        accrued = np.zeros((1, v, d)) if accrued_reward is None else np.reshape(accrued_reward, (1, v, d))
        observations = self.worlds.policy_observations(np.asarray(obs)[None]).astype(np.float32)
        actions = self.act(observations, accrued.astype(np.float32), np.full((1, v), discount, np.float32), None)
        return self.worlds.environment_actions(actions)[0]

    def _explore(
        self, observations: NDArray[np.float32], accrued: NDArray[np.float32], discounts: NDArray[np.float32]
    ) -> NDArray[Any]:
        return self.act(observations, accrued, discounts, self.generator)

    def train(
        self,
        total_timesteps: int,
        eval_env: VectorEnv | None = None,
        *,
        eval_interval: int | None = None,
        eval_episodes: int = 100,
        eval_seed: int = 1_000_000,
        eval_gamma: float = 0.99,
        log: Log | None = None,
        log_interval: int = 10,
        after_update: Callable[[ActorCritic], bool] | None = None,
    ) -> None:
        """Learn until ``total_timesteps`` environment steps have been taken, counted over all worlds.

        Args:
            total_timesteps: also what the schedules run over; a resumed run passes the same number.
            eval_env: environment of its own for evaluations, greedy and stochastic, before, during and after.
            eval_interval: environment steps between evaluations; a twentieth of the total if None.
            eval_episodes, eval_seed, eval_gamma: see `algorithms.evaluation.evaluate`.
            log: called as ``log(step, metrics)``.
            log_interval: updates between two lines of the log.
            after_update: called as ``after_update(agent)``; True stops training.
        """
        per_update = self.config.steps * self.worlds.num_envs
        interval = eval_interval or max(1, total_timesteps // EVALUATION_INTERVALS)
        if self.step == 0:
            self.collector.reset(self._worlds_seed)
            self._evaluate(eval_env, eval_episodes, eval_seed, eval_gamma, log)
        started, first = perf_counter(), self.step
        while self.step < total_timesteps:
            rollout, episodes = self.collector.collect(self._explore)
            before = self.step
            self.step += per_update
            metrics = self._learn(rollout, episodes, before / total_timesteps)
            updates = self.step // per_update
            last = self.step >= total_timesteps
            if log is None:
                self._unlogged.clear()
            elif updates % log_interval == 0 or last:
                rate = (self.step - first) / (perf_counter() - started)
                log(self.step, {**self._training_metrics(), **metrics, "time/steps_per_second": rate})
            if self.step // interval > before // interval or last:
                paused = perf_counter()
                self._evaluate(eval_env, eval_episodes, eval_seed, eval_gamma, log)
                started += perf_counter() - paused
            if after_update is not None and after_update(self):
                return

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
            for objective, mean in zip(self.worlds.objectives, returns.mean(axis=0), strict=True):
                metrics[f"{prefix}return/{objective}"] = float(mean)
        self._unlogged = []
        return metrics

    def _evaluate(self, env: VectorEnv | None, episodes: int, seed: int, gamma: float, log: Log | None) -> None:
        if env is None or log is None:
            return
        metrics: dict[str, float] = {}
        for policy in ("greedy", "stochastic"):
            result = evaluate(self, env, episodes=episodes, seed=seed, greedy=policy == "greedy", gamma=gamma)
            metrics |= {f"eval/{policy}/{name}": value for name, value in result.metrics().items()}
        log(self.step, metrics)

    def save(self, path: str | Path) -> None:
        """Write everything that determines the future to one safetensors file, atomically."""
        tensors = self._tensors()
        for name in ("vehicles", "returns", "discounted", "lengths", "succeeded"):
            arrays = [getattr(episodes, name) for episodes in self._unlogged]
            if arrays:
                tensors[f"unlogged.{name}"] = torch.from_numpy(np.concatenate(arrays))
        write_checkpoint(path, tensors, {**self._identity(), "step": self.step})

    def _tensors(self) -> dict[str, torch.Tensor]:
        """Everything that determines the future, apart from episodes that wait for the log."""
        tensors: dict[str, torch.Tensor] = {"generator": self.generator.get_state()}
        for v, learner in enumerate(self.learners):
            tensors |= {f"vehicle_{v}.{name}": tensor for name, tensor in learner.get_state().items()}
        for name, array in self.collector.get_state().items():
            tensors[f"collector.{name}"] = torch.from_numpy(np.ascontiguousarray(array))
        return tensors

    def _identity(self) -> dict[str, Any]:
        env = self.worlds.env
        return {
            "algorithm": self.name,
            "environment": env.spec.id if env.spec is not None else str(env),
            "observation_size": self.worlds.observation_size,
            "objectives": list(self.worlds.objectives),
            "cost_sign": self.worlds.cost_sign,
            "actions": [self.worlds.actions, self.worlds.continuous],
            "hidden": list(self.config.hidden),
            "centralised_critic": self.config.centralised_critic,
            "inputs": self.learners[0].input_size(self.worlds),
            "num_envs": self.worlds.num_envs,
        }

    def load(self, path: str | Path, *, policy_only: bool = False) -> None:
        """Resume from :meth:`save`; no code runs from the file.

        Args:
            path: the checkpoint.
            policy_only: take the networks alone, for evaluation with any number of worlds.

        Raises:
            ValueError: if the file is missing or broken, or belongs to another algorithm, environment or network.
        """
        may_differ = ("num_envs",) if policy_only else ()
        tensors, found = read_checkpoint(path, self._identity(), may_differ)
        for name, mine in self._tensors().items():
            needed = name.startswith("vehicle_") or not policy_only
            shape = tuple(tensors[name].shape) if name in tensors else None
            if needed and shape != tuple(mine.shape):
                raise ValueError(
                    f"checkpoint {path} has {name!r} of shape {shape}; this agent needs {tuple(mine.shape)}"
                )
        for v, learner in enumerate(self.learners):
            learner.set_state(below(tensors, f"vehicle_{v}."))
        if policy_only:
            return
        self.generator.set_state(tensors["generator"])
        self.collector.set_state({name: t.numpy() for name, t in below(tensors, "collector.").items()})
        self.step = found["step"]
        if not self.worlds.native:
            # Other environments cannot give their state: their episodes begin anew, on other seeds.
            self.collector.reset(self._worlds_seed + self.step)
        unlogged = {name: t.numpy() for name, t in below(tensors, "unlogged.").items()}
        self._unlogged = [Episodes(**unlogged)] if unlogged else []
