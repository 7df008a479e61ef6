"""What every actor-critic shares: settings, seeding, the training loop, acting, and checkpoints."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from pydantic import Field, model_validator
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_safetensors

from algorithms.evaluation import evaluate
from algorithms.files import atomic_write
from algorithms.networks import CategoricalActor, GaussianActor, mlp
from algorithms.rollout import Collector, Episodes, Rollout
from algorithms.worlds import Worlds
from mo_deepdrive.config import Settings, parse
from mo_deepdrive.utilities import Utility

CHECKPOINT_FORMAT = 1
# Worlds are trained on seeds from here on; evaluation uses smaller ones.
FIRST_TRAINING_SEED = 2**32
EVALUATION_INTERVALS = 20

Log = Callable[[int, dict[str, float]], None]


class ActorCriticConfig(Settings):
    """Hyperparameters that all actor-critics share.

    Attributes:
        learning_rate, learning_rate_end: Adam's step size, moving linearly from one to the other (None: constant).
        gamma: discount.
        gae_lambda: decay of the advantage estimator; 0 is one step, 1 the whole rollout.
        steps: decisions per world and update.
        hidden: sizes of the hidden layers of actor and critic.
        entropy_start, entropy_end, entropy_until: weight of the entropy bonus, moving geometrically from the first
            to the second over this fraction of training.
        value_coefficient: weight of the critic's loss.
        max_grad_norm: clipping of the gradient's norm.
        normalise_advantages: bring the advantages of an update to mean 0 and deviation 1.
        objective_scales: nominal size of each objective's return; None for the environment's own.
    """

    learning_rate: float = Field(default=1e-3, gt=0.0, le=1.0)
    learning_rate_end: float | None = Field(default=None, ge=0.0, le=1.0)
    gamma: float = Field(default=0.99, ge=0.0, le=1.0)
    gae_lambda: float = Field(default=0.95, ge=0.0, le=1.0)
    steps: int = Field(default=16, ge=1, le=4096)
    hidden: list[int] = Field(default=[64, 32], min_length=1)
    entropy_start: float = Field(default=0.01, ge=0.0)
    entropy_end: float = Field(default=0.01, ge=0.0)
    entropy_until: float = Field(default=1.0, gt=0.0, le=1.0)
    value_coefficient: float = Field(default=0.5, gt=0.0)
    max_grad_norm: float = Field(default=0.5, gt=0.0)
    normalise_advantages: bool = True
    objective_scales: list[float] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> ActorCriticConfig:
        if any(size < 1 for size in self.hidden):
            raise ValueError(f"hidden = {self.hidden} must be positive layer sizes")
        if (self.entropy_start == 0.0) != (self.entropy_end == 0.0):
            raise ValueError(
                f"entropy_start = {self.entropy_start} and entropy_end = {self.entropy_end} must both be positive "
                "or both be 0: the weight moves geometrically between them"
            )
        if self.objective_scales is not None and any(scale <= 0.0 for scale in self.objective_scales):
            raise ValueError(f"objective_scales = {self.objective_scales} must be positive")
        return self

    def entropy_at(self, progress: float) -> float:
        """Weight of the entropy bonus at ``progress`` in [0, 1]."""
        if self.entropy_start == 0.0:
            return 0.0
        part = min(1.0, progress / self.entropy_until)
        return self.entropy_start * (self.entropy_end / self.entropy_start) ** part

    def learning_rate_at(self, progress: float) -> float:
        """Adam's step size at ``progress`` in [0, 1]."""
        end = self.learning_rate if self.learning_rate_end is None else self.learning_rate_end
        return self.learning_rate + (end - self.learning_rate) * min(1.0, progress)


class Learner(ABC):
    """Networks and optimiser of one vehicle.

    Subclasses say what the networks see and predict, and how a rollout changes them.
    """

    def __init__(self, worlds: Worlds, utility: Utility, config: Any, generator: torch.Generator, device: torch.device):
        self.utility = utility
        self.config = config
        self.device = device
        scales = worlds.objective_scales if config.objective_scales is None else config.objective_scales
        if len(scales) != len(worlds.objectives):
            raise ValueError(
                f"objective_scales = {list(scales)} needs {len(worlds.objectives)} numbers: {worlds.objectives}"
            )
        self.observation_scales = torch.tensor(worlds.observation_scales, device=device)
        self.objective_scales = torch.tensor(np.asarray(scales, dtype=np.float32), device=device)
        inputs = self.input_size(worlds)
        kind = GaussianActor if worlds.continuous else CategoricalActor
        self.actor = kind(inputs, config.hidden, worlds.actions, generator).to(device)
        self.critic = mlp(inputs, config.hidden, self.value_size(worlds), generator, output_gain=1.0).to(device)
        self.parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimiser = torch.optim.Adam(self.parameters, lr=config.learning_rate, fused=True)

    @abstractmethod
    def input_size(self, worlds: Worlds) -> int:
        """Width of what the networks see."""

    @abstractmethod
    def value_size(self, worlds: Worlds) -> int:
        """Width of what the critic predicts."""

    @abstractmethod
    def inputs(self, observations: torch.Tensor, accrued: torch.Tensor, discounts: torch.Tensor) -> torch.Tensor:
        """What the networks see, (..., inputs), from (..., o), (..., d) and (...)."""

    @abstractmethod
    def losses(self, rollout: Rollout, entropy_weight: float) -> dict[str, torch.Tensor]:
        """The loss to descend as "total", and its parts, from the rollout of this vehicle (no vehicle axis)."""

    def finished(self, discounted_returns: NDArray[np.float64]) -> None:
        """Take note of the discounted returns (E, d) of episodes that ended; most learners need none."""
        return

    def update(self, rollout: Rollout, learning_rate: float, entropy_weight: float) -> dict[str, float]:
        """One gradient step on ``rollout``."""
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate
        losses = self.losses(rollout, entropy_weight)
        self.optimiser.zero_grad()
        losses["total"].backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
        self.optimiser.step()
        return {name: float(loss.detach()) for name, loss in losses.items() if name != "total"}

    def next_values(self, rollout: Rollout, inputs: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """v(S_{t+1}) (T, N, ...) without gradient: 0 after termination, of the true final state after truncation.

        Args:
            inputs: (T + 1, N, inputs) what the networks saw.
            values: (T, N, value size) v(S_t).
        """
        with torch.no_grad():
            following = torch.cat([values[1:].detach(), self.values(inputs[-1:])])
            following[rollout.terminated] = 0.0
            cut = rollout.truncated & ~rollout.terminated
            if cut.any():
                factors = rollout.discounts[:-1][cut]
                accrued = rollout.accrued[:-1][cut] + factors.unsqueeze(-1) * rollout.rewards[cut]
                final = self.inputs(rollout.final[cut], accrued, factors * self.config.gamma)
                following[cut] = self.values(final)
        return following

    @abstractmethod
    def values(self, inputs: torch.Tensor) -> torch.Tensor:
        """v (..., value size) in the units of the returns."""

    def policy_losses(
        self,
        rollout: Rollout,
        inputs: torch.Tensor,
        advantages: torch.Tensor,
        value_loss: torch.Tensor,
        entropy_weight: float,
    ) -> dict[str, torch.Tensor]:
        """The policy-gradient loss with entropy bonus, plus the critic's; samples that did not act do not count."""
        weight = rollout.acted.to(advantages.dtype)
        weight = weight / weight.sum().clamp(min=1.0)
        if self.config.normalise_advantages:
            mean = (weight * advantages).sum()
            deviation = (weight * (advantages - mean).square()).sum().sqrt()
            advantages = (advantages - mean) / (deviation + 1e-8)
        log_probability, entropies = self.actor.log_probability(inputs[:-1], rollout.actions)
        policy_loss = -(weight * advantages.detach() * log_probability).sum()
        critic_loss = (weight * value_loss).sum()
        entropy = (weight * entropies).sum()
        total = policy_loss + self.config.value_coefficient * critic_loss - entropy_weight * entropy
        return {"total": total, "loss/policy": policy_loss, "loss/value": critic_loss, "policy/entropy": entropy}

    def get_state(self) -> dict[str, torch.Tensor]:
        """Weights and the optimiser's state as named tensors."""
        state = {f"actor.{name}": tensor for name, tensor in self.actor.state_dict().items()}
        state |= {f"critic.{name}": tensor for name, tensor in self.critic.state_dict().items()}
        for index, entries in self.optimiser.state_dict()["state"].items():
            state |= {f"optimiser.{index}.{name}": tensor for name, tensor in entries.items()}
        return state

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`."""
        self.actor.load_state_dict(_below(state, "actor."))
        self.critic.load_state_dict(_below(state, "critic."))
        entries: dict[int, dict[str, torch.Tensor]] = {}
        for name, tensor in _below(state, "optimiser.").items():
            index, _, entry = name.partition(".")
            entries.setdefault(int(index), {})[entry] = tensor
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": entries})


def _below(state: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}


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
        self.utilities = utilities
        weights_seed, actions_seed, worlds_seed = np.random.SeedSequence(seed).generate_state(3)
        initial = torch.Generator().manual_seed(int(weights_seed))
        self.learners = [self.learner(self.worlds, u, self.config, initial, self.device) for u in utilities]
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
        """The greedy action for one observation (o,), as in morl-baselines.

        Args:
            obs: (o,), or (V, o) with several vehicles.
            accrued_reward: (d,) or (V, d) discounted sum of the episode's rewards so far; zeros if None.
            discount: gamma^t.
        """
        v = self.worlds.vehicles
        d = len(self.worlds.objectives)
        accrued = np.zeros((1, v, d)) if accrued_reward is None else np.reshape(accrued_reward, (1, v, d))
        observations = np.reshape(obs, (1, v, -1)).astype(np.float32)
        actions = self.act(observations, accrued.astype(np.float32), np.full((1, v), discount, np.float32), None)[0]
        return actions[0] if v == 1 else actions

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
            if log is not None and (updates % log_interval == 0 or last):
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
            losses = learner.update(_of_vehicle(rollout, v, self.device), learning_rate, entropy_weight)
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
        tensors: dict[str, torch.Tensor] = {"generator": self.generator.get_state()}
        for v, learner in enumerate(self.learners):
            tensors |= {f"vehicle_{v}.{name}": tensor for name, tensor in learner.get_state().items()}
        for name, array in self.collector.get_state().items():
            tensors[f"collector.{name}"] = torch.from_numpy(np.ascontiguousarray(array))
        for name in ("vehicles", "returns", "discounted", "lengths", "succeeded"):
            arrays = [getattr(episodes, name) for episodes in self._unlogged]
            if arrays:
                tensors[f"unlogged.{name}"] = torch.from_numpy(np.concatenate(arrays))
        tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
        atomic_write(Path(path), to_safetensors(tensors, metadata={"checkpoint": json.dumps(self._identity())}))

    def _identity(self) -> dict[str, Any]:
        env = self.worlds.env
        return {
            "format": CHECKPOINT_FORMAT,
            "algorithm": self.name,
            "environment": env.spec.id if env.spec is not None else str(env),
            "observation_size": self.worlds.observation_size,
            "objectives": list(self.worlds.objectives),
            "actions": [self.worlds.actions, self.worlds.continuous],
            "hidden": list(self.config.hidden),
            "num_envs": self.worlds.num_envs,
            "step": self.step,
        }

    def load(self, path: str | Path, *, policy_only: bool = False) -> None:
        """Resume from :meth:`save`; no code runs from the file.

        Args:
            path: the checkpoint.
            policy_only: take the networks alone, for evaluation with any number of worlds.

        Raises:
            ValueError: if the file is missing or broken, or belongs to another algorithm, environment or network.
        """
        try:
            with safe_open(path, framework="pt") as file:
                found = json.loads((file.metadata() or {}).get("checkpoint", "{}"))
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        except (OSError, SafetensorError, json.JSONDecodeError) as error:
            raise ValueError(f"checkpoint {path} cannot be read: {error}") from None
        mine = self._identity()
        for key in mine.keys() - {"step", *(("num_envs",) if policy_only else ())}:
            if found.get(key) != mine[key]:
                raise ValueError(f"checkpoint {path} has {key} = {found.get(key)!r}; this agent has {mine[key]!r}")
        for v, learner in enumerate(self.learners):
            learner.set_state(_below(tensors, f"vehicle_{v}."))
        if policy_only:
            return
        self.step = found["step"]
        self.generator.set_state(tensors["generator"])
        self.collector.set_state({name: t.numpy() for name, t in _below(tensors, "collector.").items()})
        unlogged = {name: t.numpy() for name, t in _below(tensors, "unlogged.").items()}
        self._unlogged = [Episodes(**unlogged)] if unlogged else []


def _of_vehicle(rollout: Rollout, v: int, device: torch.device) -> Rollout:
    """The rollout of one vehicle: every tensor without the vehicle axis, on ``device``."""
    return Rollout(**{name: tensor[:, :, v].to(device) for name, tensor in vars(rollout).items()})
