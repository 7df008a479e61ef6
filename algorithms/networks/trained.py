"""What a learner of one vehicle trains, and how it is saved."""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.files.checkpoints import strip_prefix

if TYPE_CHECKING:
    import torch

    from algorithms.networks.actors import Actor
    from algorithms.networks.optimiser import Adam


class TrainedNetworks:
    """Base of the learners: their networks and optimiser as named tensors.

    Attributes:
        vehicle: index of the vehicle.
        actor: the policy.
        critic: what the policy learns from.
        optimiser: of both.
    """

    vehicle: int
    actor: Actor
    critic: torch.nn.Module
    optimiser: Adam

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
