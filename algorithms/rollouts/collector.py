"""The collection loop of all actor-critics: T steps of N environments with V vehicles each, as one rollout."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from algorithms.rollouts.buffers import Episodes, Rollout
from mo_deepdrive.evaluation.accrued_reward import AccruedReward
from mo_deepdrive.faults import NotFinite, check_vehicles
from mo_deepdrive.rollout import Buffers, follow_episodes

if TYPE_CHECKING:
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter

# By which accrued rewards and discounts may differ from exact ones: relative, and of discounts absolute.
ROUNDING, TINY = 1e-3, 1e-6

# act(observations (N, V, o), accrued_reward) -> actions (N, V) or (N, V, k)
Act = Callable[[NDArray[np.float32], AccruedReward], NDArray[Any]]


class Collector:
    """Steps environments and keeps what continues from one rollout to the next: observations and running episodes.

    Args:
        env: the environments.
        accrued_discount: g, discount of the accrued reward; one per vehicle (V,) where they differ.
        steps: T, length of a rollout.

    Attributes:
        actions: (T, N, V) or (T, N, V, k) of the rollout.
        buffers: the rest of the rollout. ``buffers.shares`` multiplies rewards before they are accrued and learnt from;
            the undiscounted returns of episodes are the environment's.
    """

    def __init__(self, env: EnvAdapter, accrued_discount: float | NDArray[np.float32], steps: int):
        n, v, o, d = env.num_envs, env.vehicles, env.observation_size, len(env.objectives)
        self.env = env
        self.accrued_discount = accrued_discount
        self.steps = steps
        self.observations = np.zeros((n, v, o), dtype=np.float32)
        self.accrued_reward = AccruedReward.begin(n, v, d)
        self.returns = np.zeros((n, v, d), dtype=np.float64)
        action_shape = (env.actions,) if env.continuous else ()
        self.actions = np.zeros((steps, n, v, *action_shape), dtype=np.float32 if env.continuous else np.int64)
        # Reused by every rollout.
        self.buffers = Buffers(
            observations=np.zeros((steps + 1, n, v, o), dtype=np.float32),
            final=np.zeros((steps, n, v, o), dtype=np.float32),
            rewards=np.zeros((steps, n, v, d), dtype=np.float32),
            accrued=np.zeros((steps + 1, n, v, d), dtype=np.float32),
            discounts=np.ones((steps + 1, n, v), dtype=np.float32),
            flags=np.zeros((3, steps, n, v), dtype=np.bool_),
            ended=np.zeros((steps, n, v), dtype=np.bool_),
            succeeded=np.zeros((steps, n, v), dtype=np.bool_),
            ended_returns=np.zeros((steps, n, v, d), dtype=np.float64),
            ended_values=np.zeros((steps, n, v, d), dtype=np.float64),
            ended_decisions=np.zeros((steps, n, v), dtype=np.int64),
            value=self.accrued_reward.value,
            running_discounts=self.accrued_reward.discounts,
            decisions=self.accrued_reward.decisions,
            returns=self.returns,
            accrued_discounts=np.full(v, accrued_discount, dtype=np.float32),
            shares=np.ones((v, d), dtype=np.float32),
        )

    def reset(self, seed: int) -> None:
        """Reset every environment; the i-th is seeded with ``seed + i``."""
        self.observations = self.env.reset(seed)
        self.accrued_reward.restart(np.ones(self.returns.shape[:2], dtype=np.bool_))
        self.returns[:] = 0.0

    def collect(self, act: Act) -> tuple[Rollout, Episodes]:
        """Run all environments for T steps; the rollout's tensors are overwritten by the next call.

        Raises:
            NotFinite: for observations, actions, rewards or accrued rewards that are not finite.
        """
        past, buffers = self.accrued_reward, self.buffers
        for t in range(self.steps + 1):
            buffers.observations[t] = self.observations
            buffers.accrued[t] = past.value
            buffers.discounts[t] = past.discounts
            if t == self.steps:
                break
            try:
                actions = act(self.observations, past)
            except NotFinite:
                self.check_finite()  # the cause, if accrued rewards are too large
                raise
            step = self.env.step(actions)
            self.actions[t] = actions
            buffers.rewards[t] = step.rewards * buffers.shares
            buffers.final[t] = step.final
            buffers.flags[:, t] = step.terminated, step.truncated, step.acted
            buffers.ended[t] = (step.terminated | step.truncated) & step.acted
            buffers.succeeded[t] = step.succeeded
            follow_episodes(
                step.rewards,
                buffers.rewards[t],
                buffers.ended[t],
                step.acted,
                buffers.accrued_discounts,
                past.value,
                past.discounts,
                past.decisions,
                self.returns,
                buffers.ended_returns[t],
                buffers.ended_values[t],
                buffers.ended_decisions[t],
            )
            self.observations = step.observations
        return self.collected()

    def check_finite(self) -> None:
        """Refuse a rollout whose rewards or their accrued sums are not finite.

        Raises:
            NotFinite: naming the environment, the vehicle and the objective.
        """
        names, env = self.env.objectives, self.env.name
        check_vehicles("reward", self.buffers.rewards, env, names)
        check_vehicles("accrued reward", self.buffers.accrued, env, names)

    def collected(self) -> tuple[Rollout, Episodes]:
        """What the buffers have after T steps.

        Raises:
            NotFinite: as :meth:`check_finite`.
        """
        self.check_finite()
        buffers = self.buffers
        terminated, truncated, acted = torch.from_numpy(buffers.flags)
        rollout = Rollout(
            observations=torch.from_numpy(buffers.observations),
            final=torch.from_numpy(buffers.final),
            actions=torch.from_numpy(self.actions),
            rewards=torch.from_numpy(buffers.rewards),
            accrued=torch.from_numpy(buffers.accrued),
            discounts=torch.from_numpy(buffers.discounts),
            terminated=terminated,
            truncated=truncated,
            acted=acted,
        )
        ended = buffers.ended
        episodes = Episodes(
            vehicles=np.nonzero(ended)[2],
            returns=buffers.ended_returns[ended],
            discounted=buffers.ended_values[ended],
            lengths=buffers.ended_decisions[ended],
            succeeded=buffers.succeeded[ended],
        )
        return rollout, episodes

    def _own(self) -> dict[str, NDArray[Any]]:
        accrued_reward = self.accrued_reward
        return {
            "observations": self.observations,
            "accrued": accrued_reward.value,
            "discounts": accrued_reward.discounts,
            "returns": self.returns,
            "lengths": accrued_reward.decisions,
        }

    def get_state(self) -> dict[str, NDArray[Any]]:
        """What continues from one rollout to the next, the environments included."""
        own = {name: array.copy() for name, array in self._own().items()}
        return {**own, **{f"worlds.{name}": array for name, array in self.env.get_state().items()}}

    def set_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Resume from :meth:`get_state`."""
        for name, array in self._own().items():
            array[...] = state[name]
        worlds = {name.removeprefix("worlds."): array for name, array in state.items() if name.startswith("worlds.")}
        if worlds:
            self.env.set_state(worlds)

    def tensors(self) -> dict[str, torch.Tensor]:
        """:meth:`get_state` as tensors, for a checkpoint."""
        return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in self.get_state().items()}

    def resume(self, tensors: Mapping[str, torch.Tensor], step: int, env_seed: int) -> int:
        """Resume from :meth:`tensors`.

        Args:
            tensors: of a checkpoint.
            step: environment steps that had been taken.
            env_seed: of the first reset.

        Returns:
            The number of rollouts that had been collected.

        Raises:
            ValueError: if steps had been taken in environments that have not been reset, what continues does not fit
                the environments, or no rollout ends at ``step``.
        """
        self.set_state({name: tensor.numpy() for name, tensor in tensors.items()})
        worlds = self.env.get_state()
        if step and worlds and (worlds["over"].any() or not worlds["begun"].all()):
            raise ValueError(f"step = {step}, but environments have not been reset")
        if step and worlds:
            self._check()
        if not self.env.native:
            # Other libraries' environments cannot be saved, so new episodes start with different seeds.
            self.reset(env_seed + step)
        rollouts, rest = divmod(step, per_update := self.steps * self.env.num_envs)
        if rest:
            raise ValueError(f"step = {step} must be a multiple of the {per_update} steps of an update")
        return rollouts

    def _check(self) -> None:
        """Refuse what does not fit the episodes that are under way in our environments.

        Raises:
            ValueError: naming the array, its value and what is allowed.
        """
        observations, decisions = self.env.under_way()
        own = self._own()
        discounts = np.power(np.float32(self.accrued_discount), decisions, dtype=np.float64)
        largest = decisions[..., None] * self.env.objective_bounds * (1.0 + ROUNDING)
        for name, low, high in (
            ("observations", observations, observations),
            ("lengths", decisions, decisions),
            ("discounts", discounts * (1.0 - ROUNDING) - TINY, discounts * (1.0 + ROUNDING) + TINY),
            ("accrued", -largest, largest),
            ("returns", -largest, largest),
        ):
            wrong = ~((own[name] >= low) & (own[name] <= high))
            if wrong.any():
                least, greatest = (np.broadcast_to(bound, wrong.shape)[wrong][0] for bound in (low, high))
                raise ValueError(
                    f"'collector.{name}' has {own[name][wrong][0]:g}; the environments' episodes allow "
                    f"{least:g} to {greatest:g}"
                )
