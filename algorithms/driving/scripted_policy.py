"""Scripted drivers behind the interface of agents."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    import torch
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.evaluation.policy import AccruedReward


class ScriptedPolicy:
    """A policy (:class:`mo_deepdrive.evaluation.policy.Policy`) of which vehicles follow a script, and others idle.

    Args:
        env: where it drives.
        vehicle: the index of the vehicle that is driven; None for all.
        driver: gives the actions (...) or (..., k), as the environment takes them, for the observations (N, o) of that
            vehicle, or (N, V, o) of all; without one all idle.
    """

    observes_accrued_reward = False
    utilities = ()
    gamma = 1.0

    def __init__(
        self,
        env: EnvAdapter,
        vehicle: int | None = None,
        driver: Callable[[NDArray[np.float32]], NDArray[Any]] | None = None,
    ):
        self.env = env
        self._vehicle = vehicle
        self._driver = driver

    @property
    def device(self) -> torch.device:
        """The CPU; scripts draw no random numbers."""
        import torch

        return torch.device("cpu")

    def act(
        self,
        observations: NDArray[np.float32],
        _accrued_reward: AccruedReward,
        _generator: torch.Generator | None,
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o)."""
        continuous = (self.env.actions,) if self.env.continuous else ()
        actions = np.zeros((len(observations), self.env.vehicles, *continuous), np.float32 if continuous else np.int64)
        if self._driver is not None:
            driven = slice(None) if self._vehicle is None else self._vehicle
            actions[:, driven] = self._driver(observations[:, driven])
        return self.env.policy_actions(actions[:, 0] if self.env.vehicles == 1 else actions)
