"""The preferences of conditioned MO-PPO for S seeds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from algorithms.rollouts.preferences import TINY

if TYPE_CHECKING:
    from algorithms.rollouts.preferences import Preferences


class SeedPreferences:
    """Draws the preferences of N environments of S seeds as :meth:`Preferences.draw` does, and keeps the best returns.

    Args:
        preferences: of one seed; its tensors move to the device.
        shape: S, T, N and V.
        switching: probability per decision that a preference changes within an episode.
        device: of the tensors.

    Attributes:
        rollout: (S, T, N, V, m) under which a rollout has acted.
        running: the preferences (S, N, V, m) of running episodes, the ideal points (S, d), and whether (S,) any episode
            has ended.
        cost_share: c of eq. 12.
    """

    def __init__(
        self, preferences: Preferences, shape: tuple[int, int, int, int], switching: float, device: torch.device
    ):
        preferences.to(device)
        seeds, _, num_envs, vehicles = shape
        d, m = len(preferences.objectives), len(preferences.names)
        self._preferences, self._switching = preferences, switching
        self.rollout = torch.zeros(*shape, m, device=device)
        self.running = {
            "preferences": torch.zeros(seeds, num_envs, vehicles, m, device=device),
            "ideal": torch.zeros(seeds, d, device=device),
            "seen_any": torch.zeros(seeds, dtype=torch.bool, device=device),
        }
        self.cost_share = torch.ones((), device=device)
        self._concentration = (
            torch.from_numpy(preferences.config.concentration * preferences.emphasis).float().to(device)
        )
        shares = torch.from_numpy(preferences.shares[preferences.used]).float()
        self._thresholds = shares.cumsum(0)[:-1].to(device)
        # Of every decision: weights, and uniform numbers for family, switching and budgets.
        self._weights = torch.zeros(*shape, d, device=device)
        self._uniform = torch.zeros(*shape, 2 + len(preferences.budgeted), device=device)

    def draw(self, seed: int, generator: torch.Generator) -> None:
        """Draw the random numbers of an update of the seed with this index."""
        concentration = self._concentration.expand(self._weights[seed].shape)
        self._weights[seed] = torch._sample_dirichlet(concentration, generator=generator)
        self._uniform[seed].uniform_(generator=generator)

    @torch.no_grad()
    def follow(self, t: int, lengths: torch.Tensor) -> torch.Tensor:
        """The preferences (S, N, V, m) of decision t of a rollout, from the lengths (S, N, V) of running episodes."""
        weights, uniform, current = self._weights[:, t], self._uniform[:, t], self.running["preferences"]
        gains = (self.running["ideal"] > 0.0)[:, None, None]
        # Equation 12.
        of_gains = torch.where(gains, weights + TINY, 0.0)
        of_gains = of_gains / of_gains.sum(-1, keepdim=True).clamp(min=TINY)
        grown = (1.0 - self.cost_share) * of_gains + self.cost_share * weights
        weights = torch.where(gains.any(-1, keepdim=True), grown, weights)
        family = (uniform[..., :1] >= self._thresholds).sum(-1)
        drawn = self._preferences.rows(family, weights, uniform[..., 2:])
        changes = (lengths == 0) | (uniform[..., 1] < self._switching)
        current.copy_(torch.where(changes.unsqueeze(-1), drawn, current))
        self.rollout[:, t] = current
        return current

    @torch.no_grad()
    def note_episodes(self, values: torch.Tensor, ended: torch.Tensor) -> None:
        """Raise the ideal points to the best returns (S, T, N, V, d) of the episodes that ended, where a mask says."""
        best = values.masked_fill(~ended.unsqueeze(-1), -torch.inf).amax((1, 2, 3))
        ideal, seen_any = self.running["ideal"], self.running["seen_any"]
        any_ended = ended.any(-1).any(-1).any(-1)
        before = torch.where(seen_any.unsqueeze(-1), ideal, -torch.inf)
        ideal.copy_(torch.where((seen_any | any_ended).unsqueeze(-1), torch.maximum(before, best), 0.0))
        seen_any.logical_or_(any_ended)

    def write(self, seed: int, preferences: Preferences) -> None:
        """Give an agent the ideal point of the seed with this index."""
        preferences.ideal = self.running["ideal"][seed].cpu()
        preferences.seen_any = bool(self.running["seen_any"][seed])
