"""What a learner trains, and how it is saved."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from algorithms.files.checkpoints import SHARED, strip_prefix
from mo_deepdrive.evaluation.metrics import vehicle_name, vehicle_prefix

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from algorithms.networks.actors import Actor
    from algorithms.networks.optimiser import Adam


def learners_identity(learners: Sequence[TrainedNetworks]) -> dict[str, bool]:
    """What a checkpoint must share: whether vehicles share a policy."""
    return {SHARED: True} if any(len(learner.vehicles) > 1 for learner in learners) else {}


class TrainedNetworks:
    """Base of the learners: their networks and optimiser as named tensors.

    Attributes:
        vehicles: indices of the vehicles that it drives, of all of which it learns; several share one policy.
        actor: the policy.
        critic: what the policy learns from.
        optimiser: of both.
    """

    vehicles: tuple[int, ...]
    actor: Actor
    critic: torch.nn.Module
    optimiser: Adam

    @property
    def vehicle(self) -> int:
        """The only vehicle, or the first one."""
        return self.vehicles[0]

    @property
    def name(self) -> str:
        """``vehicle_0``, or ``vehicles`` of several that share it."""
        return vehicle_name(self.vehicle) if len(self.vehicles) == 1 else "vehicles"

    def metric_prefix(self, vehicles: int) -> str:
        """What the names of its losses begin with, where there are so many vehicles."""
        return vehicle_prefix(self.vehicle, vehicles) if len(self.vehicles) == 1 else ""

    def rows(self, array: NDArray[Any]) -> torch.Tensor:
        """(N k, ...) what is there for each of the k vehicles, environment by environment, from (N, V, ...)."""
        return torch.from_numpy(array[:, np.array(self.vehicles)].reshape(-1, *array.shape[2:]))

    def choose(self, inputs: torch.Tensor, generator: torch.Generator | None) -> dict[int, NDArray[Any]]:
        """The actions (N,) or (N, k) of each vehicle for inputs of :meth:`rows`; greedy where ``generator`` is None."""
        inputs = inputs.unflatten(0, (-1, len(self.vehicles)))  # so that an error names the environment
        chosen = self.actor.greedy(inputs) if generator is None else self.actor.sample(inputs, generator)
        actions = chosen.cpu().numpy()
        return {v: actions[:, j] for j, v in enumerate(self.vehicles)}

    def get_state(self) -> dict[str, torch.Tensor]:
        """Weights and the optimiser's state as named tensors."""
        state = self.get_policy()
        state |= {f"critic.{name}": tensor for name, tensor in self.critic.state_dict().items()}
        return state | {f"optimiser.{name}": tensor for name, tensor in self.optimiser.get_state().items()}

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`.

        Raises:
            ValueError: for values from which training cannot continue.
        """
        self.set_policy(state)
        self.critic.load_state_dict(strip_prefix(state, "critic."))
        self.optimiser.set_state(strip_prefix(state, "optimiser."))

    def get_policy(self) -> dict[str, torch.Tensor]:
        """The actor's weights as named tensors."""
        return {f"actor.{name}": tensor for name, tensor in self.actor.state_dict().items()}

    def set_policy(self, state: dict[str, torch.Tensor]) -> None:
        """Take the actor's weights from :meth:`get_policy` or :meth:`get_state`."""
        self.actor.load_state_dict(strip_prefix(state, "actor."))
