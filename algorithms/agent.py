"""What every agent is: seeded, trained in updates, evaluated as it goes, saved and resumed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from algorithms.common.accrued_reward import AccruedReward
from algorithms.common.checkpoints import POLICY_ONLY, read_checkpoint, write_checkpoint
from algorithms.common.env_adapter import EnvAdapter
from algorithms.evaluation.front import Front
from mo_deepdrive.config import Settings, parse
from mo_deepdrive.utilities import Utility

# EnvAdapter are trained on seeds from here on; evaluation uses smaller ones.
FIRST_TRAINING_SEED = 2**32
EVALUATION_INTERVALS = 20

Log = Callable[[int, dict[str, float]], None]
LogFront = Callable[[int, Front], None]


@dataclass(frozen=True)
class EvaluationPlan:
    """How an agent is measured while it trains.

    Attributes:
        env: a raw environment of its own.
        episodes: of every evaluation (of every policy of a front).
        seed: of the first.
        gamma: discount of what is reported.
        reference_point: (d,) of the hypervolume of a front; None for no hypervolume.
        reference_front: (k, d) best-known front; None where there is none.
    """

    env: VectorEnv
    episodes: int
    seed: int
    gamma: float
    reference_point: Sequence[float] | None = None
    reference_front: NDArray[np.float64] | None = None


class Agent(ABC):
    """Base of the agents.

    Args:
        env: a vector environment with vector rewards, from `algorithms.common.env_adapter.make_env`.
        seed: determines the run, bit for bit on one machine.
        device: where the networks live.
        hyperparameters: fields of the class's Config.

    Attributes:
        known_utility: whether the agent learns for a utility that it is given, or a front for every utility.
        utilities: one per vehicle; empty where none is known.
        step: environment steps taken.

    Raises:
        ValueError: for unknown or unfit hyperparameters or spaces.
    """

    name: ClassVar[str]
    Config: ClassVar[type[Settings]]
    known_utility: ClassVar[bool]
    config: Any

    def __init__(self, env: VectorEnv, *, seed: int, device: str, hyperparameters: Mapping[str, Any]):
        self.config = parse(self.Config, hyperparameters, f"hyperparameters of {self.name}")
        self.env = EnvAdapter(env)
        self.seed = seed
        self.device = torch.device(device)
        self.utilities: list[Utility] = []
        weights_seed, actions_seed, worlds_seed = np.random.SeedSequence(seed).generate_state(3)
        self._initial = torch.Generator().manual_seed(int(weights_seed))
        self.generator = torch.Generator(self.device).manual_seed(int(actions_seed))
        self._worlds_seed = FIRST_TRAINING_SEED + int(worlds_seed)
        self.step = 0

    @property
    def gamma(self) -> float:
        """Discount of the accrued reward."""
        return float(self.config.gamma)

    @property
    @abstractmethod
    def updates(self) -> int:
        """Updates made so far."""

    def get_config(self) -> dict[str, Any]:
        """The resolved hyperparameters, for logs."""
        return {"algorithm": self.name, "seed": self.seed, **self.config.model_dump()}

    def train(
        self,
        total_timesteps: int,
        eval_env: VectorEnv | None = None,
        *,
        eval_interval: int | None = None,
        eval_episodes: int = 100,
        eval_seed: int = 1_000_000,
        eval_gamma: float = 0.99,
        reference_point: Sequence[float] | None = None,
        reference_front: NDArray[np.float64] | None = None,
        log: Log | None = None,
        log_front: LogFront | None = None,
        log_interval: int = 10,
        after_update: Callable[[Any], bool] | None = None,
    ) -> None:
        """Learn until ``total_timesteps`` environment steps have been taken, counted over all worlds.

        Args:
            total_timesteps: also what the schedules run over; a resumed run passes the same number.
            eval_env: environment of its own for evaluations before, during and after; None for none.
            eval_interval: environment steps between evaluations; a twentieth of the total if None.
            eval_episodes, eval_seed, eval_gamma, reference_point, reference_front: see :class:`EvaluationPlan`.
            log: called as ``log(step, metrics)``.
            log_front: called as ``log_front(step, front)`` by agents that learn a front.
            log_interval: updates between two lines of the log.
            after_update: called as ``after_update(agent)``; True stops training.
        """
        interval = eval_interval or max(1, total_timesteps // EVALUATION_INTERVALS)
        plan = None
        if eval_env is not None:
            plan = EvaluationPlan(eval_env, eval_episodes, eval_seed, eval_gamma, reference_point, reference_front)
        if self.step == 0:
            self._begin()
            self._measure(plan, log, log_front)
        started, first = perf_counter(), self.step
        while self.step < total_timesteps:
            before = self.step
            metrics = self._update(before / total_timesteps)
            last = self.step >= total_timesteps
            if log is None:
                self._forget()
            elif self.updates % log_interval == 0 or last:
                rate = (self.step - first) / (perf_counter() - started)
                log(self.step, {**self._training_metrics(), **metrics, "time/steps_per_second": rate})
            if self.step // interval > before // interval or last:
                paused = perf_counter()
                self._measure(plan, log, log_front)
                started += perf_counter() - paused
            if after_update is not None and after_update(self):
                return

    def _measure(self, plan: EvaluationPlan | None, log: Log | None, log_front: LogFront | None) -> None:
        if plan is None or (log is None and log_front is None):
            return
        metrics, front = self._evaluate(plan)
        if log is not None:
            log(self.step, metrics)
        if log_front is not None and front is not None:
            log_front(self.step, front)

    @abstractmethod
    def _begin(self) -> None:
        """Get ready for the first update."""

    @abstractmethod
    def _update(self, progress: float) -> dict[str, float]:
        """Act and learn once at ``progress`` in [0, 1): count the steps taken, give the losses by name."""

    @abstractmethod
    def _training_metrics(self) -> dict[str, float]:
        """Means over the episodes that ended since the last line of the log."""

    @abstractmethod
    def _forget(self) -> None:
        """Drop the episodes that wait for the log."""

    @abstractmethod
    def _evaluate(self, plan: EvaluationPlan) -> tuple[dict[str, float], Front | None]:
        """Metrics of the present policies, and their front where the agent learns one."""

    @abstractmethod
    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o) in episodes that have come to ``accrued_reward``.

        ``generator`` None acts greedily.
        """

    def save(self, path: str | Path) -> None:
        """Write everything that determines the future to one safetensors file, atomically."""
        write_checkpoint(path, self._get_state(), {**self._identity(), "step": self.step})

    def save_policy(self, path: str | Path) -> None:
        """Write only what driving needs to one safetensors file, atomically; ``load(..., policy_only=True)`` reads it.

        Raises:
            ValueError: if there is no policy yet.
        """
        write_checkpoint(path, self._get_policy(), {**self._identity(), "step": self.step, POLICY_ONLY: True})

    def load(self, path: str | Path, *, policy_only: bool = False) -> None:
        """Resume from :meth:`save`; no code runs from the file.

        Args:
            path: the checkpoint.
            policy_only: take the policy alone, for evaluation with any number of worlds; :meth:`save_policy` is enough.

        Raises:
            ValueError: if the file is missing or broken, belongs to another algorithm, environment or network, or
                holds the policy alone where more is needed.
        """
        may_differ = ("num_envs",) if policy_only else ()
        tensors, found = read_checkpoint(path, self._identity(), may_differ, whole=not policy_only)
        for name, shape in self._shapes(policy_only).items():
            stored = tuple(tensors[name].shape) if name in tensors else None
            if stored != shape:
                raise ValueError(f"checkpoint {path} has {name!r} of shape {stored}; this agent needs {shape}")
        if policy_only:
            self._set_policy(tensors)
            return
        self._set_state(tensors)
        self.step = found["step"]
        self._resumed()

    def _identity(self) -> dict[str, Any]:
        """What a checkpoint must share with the agent that reads it."""
        return {
            "algorithm": self.name,
            "environment": self.env.name,
            "observation_size": self.env.observation_size,
            "objectives": list(self.env.objectives),
            "cost_sign": self.env.cost_sign,
            "actions": [self.env.actions, self.env.continuous],
            "hidden": list(self.config.hidden),
            "num_envs": self.env.num_envs,
        }

    @abstractmethod
    def _get_state(self) -> dict[str, torch.Tensor]:
        """Everything that determines the future."""

    @abstractmethod
    def _get_policy(self) -> dict[str, torch.Tensor]:
        """What driving needs: a part of :meth:`_get_state`, or a summary of it."""

    @abstractmethod
    def _shapes(self, policy_only: bool) -> dict[str, tuple[int, ...]]:
        """Tensors that a checkpoint must hold, in shapes that the agent knows before it reads one."""

    @abstractmethod
    def _set_state(self, tensors: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`_get_state`."""

    @abstractmethod
    def _set_policy(self, tensors: dict[str, torch.Tensor]) -> None:
        """Drive as the agent of :meth:`_get_policy` or :meth:`_get_state` does."""

    def _resumed(self) -> None:
        """Called when a checkpoint has been read whole and ``step`` is known."""
        return
