"""One vehicle's learner for S seeds: how it acts and learns from the rollouts of all of them."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch.func import vmap

from algorithms.device.compiling import Compiled
from algorithms.device.networks import SeedNetworks
from algorithms.networks.losses import policy_shift
from algorithms.rollouts.buffers import Rollout, Samples
from algorithms.rollouts.running_mean import MEMORY
from mo_deepdrive.evaluation.metrics import APPROX_KL, CLIP_FRACTION, ENTROPY, POLICY_LOSS, VALUE_LOSS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from algorithms.rollouts.buffers import VehicleRollout


LOG_RATIO = "log_ratio"
SEEN = ("observations", "accrued", "discounts")  # of what an actor sees


class SeedLearner:
    """The learner of one vehicle, with the seeds as an axis.

    Args:
        learner: of the algorithm, on the device; it lends equations and the structure of networks.
        learners: the S learners whose parameters are the first ones.
        num_envs: N.
        device: of the tensors.
        compiled: whether ``torch.compile`` makes what is done for all seeds into few kernels.

    Attributes:
        networks: of all seeds.
        noise: (S, T, N, k) random numbers of the actions of a rollout.
        keys: (S, epochs, T N) random numbers by whose order the samples of an epoch are shuffled.
        losses: (S,) by name, the means over the gradient steps of the last update.
        expected_return: (S, d) E[R], running means of the accrued rewards of episodes.
        episodes: (S,) their numbers.
    """

    def __init__(self, learner: Any, learners: Sequence[Any], num_envs: int, device: torch.device, *, compiled: bool):
        config = learner.config
        learner.static_shapes = True
        self.learner, self.config, self.vehicle = learner, config, learner.vehicle
        self.networks = SeedNetworks(learner, learners)
        seeds, samples = len(learners), config.steps * num_envs
        self.epochs, self.minibatches = getattr(config, "epochs", 1), min(getattr(config, "minibatches", 1), samples)
        width = learner.actor.noise(1, torch.Generator(device)).shape[1]
        self.noise = torch.zeros(seeds, config.steps, num_envs, width, device=device)
        self.keys = torch.zeros(seeds, self.epochs, samples, device=device)
        self.losses: dict[str, torch.Tensor] = {}
        self.mean_returns = hasattr(learner, "expected_return")
        width = len(learner.expected_return.value) if self.mean_returns else 0
        self.expected_return = torch.zeros(seeds, width, device=device)
        self.episodes = torch.zeros(seeds, device=device)
        self._choose = Compiled(partial(self.networks.call, self._action), enabled=compiled)
        self._prepare = Compiled(partial(self.networks.call, self._samples), enabled=compiled)
        self._step = Compiled(partial(self.networks.minimise, self._loss), enabled=compiled)
        for seed, each in enumerate(learners):
            self.read(seed, each)

    def draw(self, seed: int, generator: torch.Generator) -> None:
        """Draw the random numbers of an update of the seed with this index."""
        noise = self.noise[seed]
        noise.copy_(self.learner.actor.noise(noise[..., 0].numel(), generator).view(noise.shape))
        self.keys[seed].uniform_(generator=generator)

    @torch.no_grad()
    def act(self, t: int, now: Mapping[str, torch.Tensor], *shared: Any) -> torch.Tensor:
        """Actions (S, N) or (S, N, k) of step t of a rollout.

        Args:
            t: the step.
            now: observations, accrued rewards and discounts, (S, N, V, ...).
            *shared: what :meth:`inputs` also takes, (S, ...).
        """
        own = {name: now[name][:, :, self.vehicle] for name in SEEN}
        actions: torch.Tensor = self._choose(self.networks.vector, own, self.noise[:, t], *shared)
        return actions

    def _action(self, own: dict[str, torch.Tensor], noise: torch.Tensor, *shared: Any) -> torch.Tensor:
        actor = self.learner.actor
        chosen: torch.Tensor = actor.choose(actor.body(self.inputs(own, *shared)), noise)
        return chosen

    def inputs(self, own: dict[str, torch.Tensor], *shared: Any) -> torch.Tensor:
        """What the actor of a seed sees."""
        del shared
        found: torch.Tensor = self.learner.inputs(*(own[name] for name in SEEN))
        return found

    def samples(self, rollout: VehicleRollout, *shared: Any) -> Samples:
        """What a seed learns from its rollout."""
        if shared:
            (self.learner.team,) = shared
        found: Samples = self.learner.samples(rollout)
        return found

    def update(
        self,
        rollout: Mapping[str, torch.Tensor],
        learning_rate: torch.Tensor,
        entropy_coefficient: torch.Tensor,
        *shared: Any,
    ) -> None:
        """Learn from a rollout (S, T, N, V, ...).

        Args:
            rollout: the fields of :class:`algorithms.rollouts.buffers.Rollout`.
            learning_rate: of Adam.
            entropy_coefficient: c_e.
            *shared: what :meth:`samples` also takes, (S, ...).
        """
        config = self.config
        samples = self._prepare(self.networks.vector, dict(rollout), self.expected_return, *shared)
        minibatches = [each for epoch in range(self.epochs) for each in self._minibatches(samples, self.keys[:, epoch])]
        steps = [
            self._step(self.networks.state, minibatch, entropy_coefficient, learning_rate) for minibatch in minibatches
        ]
        parts = [name for name in steps[0] if name != LOG_RATIO]
        self.losses = {name: torch.stack([step[name] for step in steps], dim=1).mean(1) for name in parts}
        if LOG_RATIO in steps[0]:
            log_ratios = torch.cat([step[LOG_RATIO] for step in steps], dim=1)
            weights = [torch.cat([each["weights"] for each in minibatches], dim=1)] if "weights" in samples else []
            changes = vmap(lambda each, *own: policy_shift(each, config.clip, *own))(log_ratios, *weights)
            self.losses |= dict(zip((CLIP_FRACTION, APPROX_KL), changes, strict=True))

    def _samples(
        self, rollout: dict[str, torch.Tensor], expected_return: torch.Tensor, *shared: Any
    ) -> dict[str, torch.Tensor]:
        """What a seed learns from its rollout, by the fields of :class:`algorithms.rollouts.buffers.Samples`."""
        others = getattr(self.learner, "others_size", 0) > 0
        part = Rollout(**rollout).of_vehicle(self.vehicle, expected_return.device, others=others)
        if self.mean_returns:
            self.learner.expected_return.value = expected_return
        found = self.samples(part, *shared)._asdict()
        left_out = "weights" if rollout["acted"].shape[-1] == 1 else ""  # a single vehicle acts in every step
        return {name: each for name, each in found.items() if each is not None and name != left_out}

    def _loss(
        self, samples: dict[str, torch.Tensor], entropy_coefficient: torch.Tensor
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """The loss of a seed, and its parts by name."""
        losses = self.learner.loss(Samples(**samples), entropy_coefficient)
        parts = {POLICY_LOSS: losses.policy, VALUE_LOSS: losses.value, ENTROPY: losses.entropy}
        if losses.log_ratio is not None:
            parts[LOG_RATIO] = losses.log_ratio
        return losses.total, parts

    def _minibatches(self, samples: dict[str, torch.Tensor], keys: torch.Tensor) -> list[dict[str, torch.Tensor]]:
        """The samples in the order of their keys, in parts that have, but for one, as many of weight 1."""
        if self.minibatches == 1:
            return [samples]
        order = (keys + (samples["weights"] == 0.0) if "weights" in samples else keys).argsort(dim=-1)
        rows = torch.arange(len(order), device=order.device).unsqueeze(1)
        shuffled: dict[int, torch.Tensor] = {}  # by address: where the critic sees what the actor sees, it is kept once
        for tensor in samples.values():
            if tensor.data_ptr() not in shuffled:
                shuffled[tensor.data_ptr()] = tensor[rows, order]
        whole = {name: shuffled[tensor.data_ptr()] for name, tensor in samples.items()}
        return [
            {name: tensor[:, part :: self.minibatches] for name, tensor in whole.items()}
            for part in range(self.minibatches)
        ]

    @torch.no_grad()
    def note_episodes(self, values: torch.Tensor, ended: torch.Tensor) -> None:
        """Update E[R] with the accrued rewards (S, T, N, d) of the episodes that ended, where a mask (S, T, N) says."""
        if not self.mean_returns:
            return
        number = ended.sum((1, 2)).float()
        mean = values.masked_fill(~ended.unsqueeze(-1), 0.0).sum((1, 2)) / number.clamp(min=1.0).unsqueeze(-1)
        keep = torch.where(self.episodes > 0, MEMORY**number, (number == 0).float()).unsqueeze(-1)
        self.expected_return.copy_(keep * self.expected_return + (1.0 - keep) * mean)
        self.episodes += number

    # ------------------------------------------------------------------------------- from and to a learner of one seed

    def read(self, seed: int, learner: Any) -> None:
        """Take over the state of a learner as that of the seed with this index."""
        self.networks.read(seed, learner)
        if self.mean_returns:
            mean = learner.expected_return
            self.expected_return[seed], self.episodes[seed] = mean.value, mean.count

    def write(self, seed: int, learner: Any) -> None:
        """Give a learner the state of the seed with this index."""
        self.networks.write(seed, learner)
        if self.mean_returns:
            mean = learner.expected_return
            mean.value, mean.count = self.expected_return[seed].cpu(), int(self.episodes[seed])


class ConditionedSeedLearner(SeedLearner):
    """The learner of conditioned MO-PPO; preferences and ideal points are shared."""

    def inputs(self, own: dict[str, torch.Tensor], *shared: Any) -> torch.Tensor:
        """What the actor of a seed sees under preferences (N, V, m), with an ideal point (d,)."""
        preferences, self.learner.preferences.ideal = shared
        observations, *past = (own[name] for name in SEEN)
        found: torch.Tensor = self.learner.inputs(observations, preferences[:, self.vehicle], *past)
        return found

    def samples(self, rollout: VehicleRollout, *shared: Any) -> Samples:
        """What a seed learns from its rollout under preferences (T, N, V, m), with an ideal point (d,)."""
        preferences, self.learner.preferences.ideal = shared
        found: Samples = self.learner.samples(rollout, preferences[:, :, self.vehicle])
        return found
