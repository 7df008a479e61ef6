"""One vehicle's learner for S seeds: how it acts and learns from the rollouts of all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from algorithms.device.networks import SeedNetworks
from algorithms.rollouts.buffers import Rollout
from algorithms.rollouts.running_mean import MEMORY

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


class SeedLearner:
    """The learner of one vehicle, with the seeds as an axis.

    Args:
        learner: of the algorithm, on the device; it lends equations and the structure of networks.
        learners: the S learners whose parameters are the first ones.
        num_envs: N.
        device: of the tensors.

    Attributes:
        networks: of all seeds.
        noise: (S, T, N, k) random numbers of the actions of a rollout.
        keys: (S, epochs, T N) random numbers by whose order the samples of an epoch are shuffled.
        losses: (S,) by name, the means over the gradient steps of the last update.
        expected_return: (S, d) E[R], running means of the accrued rewards of episodes.
        episodes: (S,) their numbers.
    """

    def __init__(self, learner: Any, learners: Sequence[Any], num_envs: int, device: torch.device):
        config = learner.config
        self.learner, self.config, self.vehicle = learner, config, learner.vehicle
        self.networks = SeedNetworks(learner, learners)
        seeds, samples = len(learners), config.steps * num_envs
        self.epochs, self.minibatches = getattr(config, "epochs", 1), min(getattr(config, "minibatches", 1), samples)
        width = learner.actor.noise_width
        self.noise = torch.zeros(seeds, config.steps, num_envs, width, device=device)
        self.keys = torch.zeros(seeds, self.epochs, samples, device=device)
        self.losses: dict[str, torch.Tensor] = {}
        self.expected_return = torch.zeros(seeds, len(learner.objective_scales), device=device)
        self.episodes = torch.zeros(seeds, device=device)
        for seed, each in enumerate(learners):
            self.read(seed, each)

    def draw(self, seed: int, generator: torch.Generator) -> None:
        """Draw the random numbers of an update of the seed with this index."""
        self.learner.actor.fill_noise(self.noise[seed], generator)
        self.keys[seed].uniform_(generator=generator)

    @torch.no_grad()
    def act(self, t: int, now: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Actions (S, N) or (S, N, k) of step t of a rollout."""
        own = (now[name][:, :, self.vehicle] for name in ("observations", "accrued", "discounts"))
        x = self.learner.inputs(*own)
        actions: torch.Tensor = self.networks.call(self.learner.actor.choose, x, self.noise[:, t])
        return actions

    def update(
        self, rollout: dict[str, torch.Tensor], learning_rate: torch.Tensor, entropy_coefficient: torch.Tensor
    ) -> None:
        """Learn from a rollout (S, T, N, V, ...)."""
        learner, config = self.learner, self.config
        others = learner.others_size > 0

        def prepare(own: dict[str, torch.Tensor], expected_return: torch.Tensor) -> Any:
            part = Rollout(**own).of_vehicle(self.vehicle, expected_return.device, others=others)
            return learner.masked_samples(part, expected_return)

        with torch.no_grad():
            samples = self.networks.call(prepare, rollout, self.expected_return)
        found: list[dict[str, torch.Tensor]] = []
        for epoch in range(self.epochs):
            for minibatch in self._minibatches(samples, self.keys[:, epoch]):
                found.append(
                    self.networks.minimise(
                        lambda own: learner.masked_loss(own, entropy_coefficient),
                        learning_rate,
                        config.max_grad_norm,
                        minibatch,
                    )
                )
        self.losses = {name: torch.stack([each[name] for each in found], dim=1).mean(1).detach() for name in found[0]}

    def _minibatches(self, samples: Any, keys: torch.Tensor) -> list[Any]:
        """The samples in the order of their keys in parts that have, but for one, as many that count."""
        if self.minibatches == 1:
            return [samples]
        order = (keys + 2.0 * (samples.weights == 0.0)).argsort(dim=-1)
        rows = torch.arange(len(order), device=order.device).unsqueeze(1)
        parts = (order[:, part :: self.minibatches] for part in range(self.minibatches))
        return [type(samples)(*(each[rows, part] for each in samples)) for part in parts]

    @torch.no_grad()
    def note_episodes(self, values: torch.Tensor, ended: torch.Tensor) -> None:
        """Update E[R] with the accrued rewards (S, T, N, d) of the episodes that ended, where a mask (S, T, N) says."""
        number = ended.sum((1, 2)).float()
        mean = values.masked_fill(~ended.unsqueeze(-1), 0.0).sum((1, 2)) / number.clamp(min=1.0).unsqueeze(-1)
        keep = torch.where(self.episodes > 0, MEMORY**number, (number == 0).float()).unsqueeze(-1)
        self.expected_return.copy_(keep * self.expected_return + (1.0 - keep) * mean)
        self.episodes += number

    # ------------------------------------------------------------------------------- from and to a learner of one seed

    def read(self, seed: int, learner: Any) -> None:
        """Take over the state of a learner as that of the seed with this index."""
        self.networks.read(seed, learner)

    def write(self, seed: int, learner: Any, *, optimiser: bool = False) -> None:
        """Give a learner the state of the seed with this index."""
        self.networks.write(seed, learner, optimiser=optimiser)

    def get_state(self, seed: int) -> dict[str, torch.Tensor]:
        """What continues of the seed with this index and is not part of a learner."""
        return {"expected_return": self.expected_return[seed], "episodes": self.episodes[seed]}

    def set_state(self, seed: int, state: Mapping[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`."""
        self.expected_return[seed], self.episodes[seed] = state["expected_return"], state["episodes"]
