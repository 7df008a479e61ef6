"""What can be evaluated: an agent, a policy of a front, or another library's policy behind an adapter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    import torch
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.accrued_reward import AccruedReward
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.utilities import Utility


class Policy(Protocol):
    """What can be evaluated: an agent, a policy of a front, or another library's policy behind an adapter."""

    @property
    def env(self) -> EnvAdapter:
        """The environment that it was trained on."""

    @property
    def utilities(self) -> Sequence[Utility]:
        """One per vehicle; empty if no utility is known."""

    @property
    def gamma(self) -> float | NDArray[np.float32]:
        """Discount factor of the accrued reward that it observes; one per vehicle (V,) where they differ."""

    @property
    def device(self) -> torch.device:
        """Where its generator draws random numbers."""

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o); greedy if ``generator`` is None."""


def seeded_generator(policy: Policy, seed: int) -> torch.Generator:
    """A generator on the policy's device."""
    import torch

    return torch.Generator(policy.device).manual_seed(seed)


def check_same_task(found: EnvAdapter, expected: EnvAdapter) -> None:
    """Check that policies of one environment can act in another.

    Raises:
        ValueError: if id, observations, actions or objectives differ.
    """
    for what in ("name", "vehicles", "observation_size", "actions", "continuous", "objectives", "cost_sign"):
        mine, other = getattr(expected, what), getattr(found, what)
        if mine != other:
            raise ValueError(f"a policy for {what} = {other!r} cannot drive where {what} = {mine!r}")
