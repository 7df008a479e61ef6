"""Base class of the agents: acting, training with periodic evaluation, saving and loading.

A new algorithm defines ``act``, ``update``, ``get_state`` and ``set_state``; everything else has a default.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from algorithms.common.checkpoints import (
    POLICY_ONLY,
    STEP,
    check_tensors,
    read_checkpoint,
    strip_prefix,
    write_checkpoint,
)
from algorithms.common.env_adapter import EnvAdapter
from algorithms.common.rollout import Episodes
from algorithms.evaluation.episodes import evaluate
from algorithms.evaluation.front import Front
from algorithms.evaluation.metrics import (
    GREEDY,
    STEPS_PER_SECOND,
    STOCHASTIC,
    TRAIN,
    evaluation_prefix,
    summarise,
    vehicle_prefix,
)
from algorithms.evaluation.splits import FIRST_TRAINING_SEED, SPLITS
from mo_deepdrive.config import Settings, parse

if TYPE_CHECKING:
    from pathlib import Path

    from gymnasium.vector import VectorEnv
    from numpy.typing import NDArray

    from algorithms.common.accrued_reward import AccruedReward
    from mo_deepdrive.utilities import Utility

EVALUATION_INTERVALS = 20
EPISODES = "unlogged."  # prefix of the tensors of episodes that have not been logged yet

Log = Callable[[int, dict[str, float]], None]
LogFront = Callable[[int, Front], None]


@dataclass(frozen=True)
class EvaluationPlan:
    """How an agent is evaluated while it trains.

    Attributes:
        env: a raw environment, used for nothing else.
        episodes: per evaluation (per policy of a front).
        seed: of the first episode.
        gamma: discount of the reported returns.
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
    """Base of all agents.

    Args:
        env: a vector environment with vector rewards, from `algorithms.common.env_adapter.make_env`.
        seed: determines the run, bit for bit on one machine.
        device: of the networks.
        hyperparameters: fields of the class's Config.

    Attributes:
        known_utility: whether the agent learns for a known utility, or a front for every utility.
        varying_shapes: parts of the names of tensors whose shapes are not known before a checkpoint is read;
            ``set_state`` and ``set_policy`` check them.
        env: the training environment in the trainers' shapes.
        utilities: one per vehicle; empty where none is known.
        step: environment steps taken, over all parallel environments.
        updates: rollouts, or rounds of episodes, that have been collected.
        episodes: those that ended since training metrics were last logged.
        initial: generator of the initial weights.
        generator: generator of the exploring actions.
        env_seed: of the first reset of the training environment.

    Raises:
        ValueError: for unknown or invalid hyperparameters or spaces.
    """

    name: ClassVar[str]
    Config: ClassVar[type[Settings]]
    known_utility: ClassVar[bool]
    varying_shapes: ClassVar[tuple[str, ...]] = ("optimiser.",)
    config: Any

    def __init__(self, env: VectorEnv, *, seed: int, device: str, hyperparameters: Mapping[str, Any]):
        self.config = parse(self.Config, hyperparameters, f"hyperparameters of {self.name}")
        self.env = EnvAdapter(env)
        self.seed = seed
        self.device = torch.device(device)
        self.utilities: list[Utility] = []
        weights_seed, actions_seed, env_seed = np.random.SeedSequence(seed).generate_state(3)
        self.initial = torch.Generator().manual_seed(int(weights_seed))
        self.generator = torch.Generator(self.device).manual_seed(int(actions_seed))
        self.env_seed = FIRST_TRAINING_SEED + int(env_seed)
        self.step = 0
        self.updates = 0
        self.episodes: list[Episodes] = []

    @property
    def gamma(self) -> float:
        """Discount of the accrued reward."""
        return float(self.config.gamma)

    def get_config(self) -> dict[str, Any]:
        """The resolved hyperparameters, for logs."""
        return {"algorithm": self.name, "seed": self.seed, **self.config.model_dump()}

    # ---------------------------------------------------------------------------------------- what an algorithm defines

    @abstractmethod
    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o) and the accrued rewards of the running episodes.

        ``generator`` None acts greedily.
        """

    def begin(self) -> None:
        """Prepare the first update: reset environments, collect first episodes."""
        return

    @abstractmethod
    def update(self, progress: float) -> dict[str, float]:
        """Act and learn once, and return the losses by name.

        Adds to ``step`` and ``updates``, and to ``episodes`` those that ended.

        Args:
            progress: fraction of training that is done, in [0, 1), for schedules.
        """

    @abstractmethod
    def get_state(self) -> dict[str, torch.Tensor]:
        """The complete training state, as named tensors."""

    @abstractmethod
    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`; ``step`` is set already.

        Raises:
            ValueError: for values from which training cannot continue; a part of the state may be set already.
        """

    def get_policy(self) -> dict[str, torch.Tensor]:
        """What acting needs: a part of :meth:`get_state`, or a summary of it."""
        return self.get_state()

    def set_policy(self, state: dict[str, torch.Tensor]) -> None:
        """Act as the agent of :meth:`get_policy` or :meth:`get_state`."""
        self.set_state(state)

    def evaluate(self, plan: EvaluationPlan) -> tuple[dict[str, float], Front | None]:
        """Metrics of the current policy, greedy and stochastic; a front too where the agent learns one."""
        metrics: dict[str, float] = {}
        for policy in (GREEDY, STOCHASTIC):
            result = evaluate(
                self, plan.env, episodes=plan.episodes, seed=plan.seed, greedy=policy == GREEDY, gamma=plan.gamma
            )
            metrics |= {evaluation_prefix(policy) + name: value for name, value in result.metrics().items()}
        return metrics, None

    def identity(self) -> dict[str, Any]:
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

    # -------------------------------------------------------------------------------------------------------- training

    def train(
        self,
        total_timesteps: int,
        eval_env: VectorEnv | None = None,
        *,
        eval_interval: int | None = None,
        eval_episodes: int = 100,
        eval_seed: int = SPLITS["validation"].start,
        eval_gamma: float = 0.99,
        reference_point: Sequence[float] | None = None,
        reference_front: NDArray[np.float64] | None = None,
        log: Log | None = None,
        log_front: LogFront | None = None,
        log_interval: int = 10,
        after_update: Callable[[Any], bool] | None = None,
    ) -> None:
        """Learn until ``total_timesteps`` environment steps have been taken, over all parallel environments together.

        Args:
            total_timesteps: also the length of schedules; a resumed run passes the same number.
            eval_env: a separate environment for evaluations before, during and after training; None for none.
            eval_interval: environment steps between evaluations; a twentieth of the total if None.
            eval_episodes: episodes per evaluation (per policy of a front).
            eval_seed: seed of the first episode.
            eval_gamma: discount of the reported returns.
            reference_point: (d,) of the hypervolume of a front; None for no hypervolume.
            reference_front: (k, d) best-known front; None where there is none.
            log: called as ``log(step, metrics)``.
            log_front: called as ``log_front(step, front)`` by agents that learn a front.
            log_interval: updates between two rows of training metrics.
            after_update: called as ``after_update(agent)``; True stops training.
        """
        interval = eval_interval or max(1, total_timesteps // EVALUATION_INTERVALS)
        plan = None
        if eval_env is not None:
            plan = EvaluationPlan(eval_env, eval_episodes, eval_seed, eval_gamma, reference_point, reference_front)
        if self.step == 0:
            self.begin()
            self._log_evaluation(plan, log, log_front)
        started, first = perf_counter(), self.step
        while self.step < total_timesteps:
            before = self.step
            metrics = self.update(before / total_timesteps)
            last = self.step >= total_timesteps
            if log is None:
                self.episodes.clear()
            elif self.updates % log_interval == 0 or last:
                rate = (self.step - first) / (perf_counter() - started)
                log(self.step, {**self._training_metrics(), **metrics, STEPS_PER_SECOND: rate})
            if self.step // interval > before // interval or last:
                paused = perf_counter()
                self._log_evaluation(plan, log, log_front)
                started += perf_counter() - paused
            if after_update is not None and after_update(self):
                return

    def _log_evaluation(self, plan: EvaluationPlan | None, log: Log | None, log_front: LogFront | None) -> None:
        if plan is None or (log is None and log_front is None):
            return
        metrics, front = self.evaluate(plan)
        if log is not None:
            log(self.step, metrics)
        if log_front is not None and front is not None:
            log_front(self.step, front)

    def _training_metrics(self) -> dict[str, float]:
        """Means over the episodes that ended since the last call, which are then forgotten."""
        episodes, self.episodes = Episodes.join(self.episodes, len(self.env.objectives)), []
        metrics: dict[str, float] = {}
        for v in range(self.env.vehicles):
            mine = episodes.vehicles == v
            if mine.any():
                summary = summarise(
                    self.env.objectives,
                    episodes.returns[mine],
                    episodes.lengths[mine],
                    episodes.succeeded[mine],
                    utility=self.utilities[v] if self.utilities else None,
                )
                prefix = TRAIN + vehicle_prefix(v, self.env.vehicles)
                metrics |= {prefix + name: value for name, value in summary.items()}
        return metrics

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def save(self, path: str | Path) -> None:
        """Write the complete training state to one safetensors file, atomically."""
        episodes = Episodes.join(self.episodes, len(self.env.objectives))
        unlogged = {f"{EPISODES}{name}": torch.from_numpy(array) for name, array in vars(episodes).items()}
        write_checkpoint(path, {**self.get_state(), **unlogged}, {**self.identity(), STEP: self.step})

    def save_policy(self, path: str | Path) -> None:
        """Write only what acting needs to one safetensors file, atomically; ``load(..., policy_only=True)`` reads it.

        Raises:
            ValueError: if there is no policy yet.
        """
        write_checkpoint(path, self.get_policy(), {**self.identity(), STEP: self.step, POLICY_ONLY: True})

    def load(self, path: str | Path, *, policy_only: bool = False) -> None:
        """Resume from :meth:`save`; no code is run from the file.

        Args:
            path: the checkpoint.
            policy_only: load the policy alone, to act in any number of environments; :meth:`save_policy` is enough.

        Raises:
            ValueError: if the file is missing or broken, belongs to another algorithm, environment or network, has
                values from which training cannot continue, or holds the policy alone where more is needed.
        """
        may_differ = ("num_envs",) if policy_only else ()
        tensors, found = read_checkpoint(path, self.identity(), may_differ, whole=not policy_only)
        expected = self.get_policy() if policy_only else self.get_state()
        tensors = check_tensors(path, tensors, expected, (EPISODES, *self.varying_shapes), whole=not policy_only)
        step, before = self.step, {name: each.clone() for name, each in {**self.get_state(), **expected}.items()}
        try:
            if policy_only:
                self.set_policy(tensors)
                return
            self.step = found[STEP]
            self.set_state(tensors)
            unlogged = {name: tensor.numpy() for name, tensor in strip_prefix(tensors, EPISODES).items()}
            self.episodes = [Episodes.of_arrays(unlogged, len(self.env.objectives))] if unlogged else []
        except (ValueError, RuntimeError) as error:
            self.step = step
            self.set_state(before)
            raise ValueError(f"checkpoint {path}: {str(error).splitlines()[0]}") from None
