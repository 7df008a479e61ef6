"""Guided starts: another driver begins some of the training's episodes, and the learner takes over on the way.

What lies behind a hard part of an episode is seldom seen by a policy that has not learnt that part. A guide drives to
states along the way, and the learner begins there (Uchendu et al. 2023, jump-start reinforcement learning); how often
falls to never. The learner learns from its own decisions alone, and nothing of the guide is left in its policy.

I. Uchendu, T. Xiao, Y. Lu, B. Zhu, M. Yan, J. Simon, M. Bennice, C. Fu, C. Ma, J. Jiao, S. Levine, K. Hausman,
"Jump-start reinforcement learning", ICML 2023.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from algorithms.hyperparameters import GuideSettings
    from mo_deepdrive.evaluation.policy import AccruedReward
    from mo_deepdrive.evaluation.team import Population


class Guide:
    """Drives one vehicle of N environments of every seed at the start of some episodes."""

    def __init__(self, driver: Population, settings: GuideSettings, num_envs: int):
        if len(driver.members) > 1:
            raise ValueError(f"a guide is one driver, not {len(driver.members)} that take turns")
        self.driver, self.settings, self.vehicle = driver, settings, driver.vehicle
        # By seed, (N,) the decisions after which the learner drives in the running episodes.
        self.handovers = [np.zeros(num_envs, dtype=np.int64)]
        self._share = 0.0

    def repeat(self, seeds: int) -> None:
        """Begin anew, for so many seeds."""
        self.handovers = [np.zeros_like(self.handovers[0]) for _ in range(seeds)]

    def begin_rollout(self, progress: float) -> None:
        """Set the share of guided episodes for a rollout at ``progress``, the fraction of the training that is done."""
        self._share = self.settings.share * max(0.0, 1.0 - progress / self.settings.until)

    def drive(
        self,
        actions: NDArray[Any],
        observations: NDArray[np.float32],
        accrued_reward: AccruedReward,
        generator: torch.Generator,
        seed: int = 0,
    ) -> NDArray[np.bool_]:
        """Overwrite the vehicle's actions (N, V) or (N, V, k) where the guide drives; the mask (N,) of where it does.

        The generator draws when the learner takes over, and the actions of a guide that samples.
        """
        decisions, handover = accrued_reward.decisions[:, self.vehicle], self.handovers[seed]
        begin = np.flatnonzero(decisions == 0)
        if len(begin):
            guided, length = torch.rand((2, len(begin)), generator=generator, device=generator.device).cpu().numpy()
            lengths = 1 + (self.settings.decisions * length).astype(np.int64)
            handover[begin] = np.where(guided < self._share, lengths, 0)
        led = decisions < handover
        rows = np.flatnonzero(led)
        if len(rows):
            actions[rows, self.vehicle] = self.driver.act(observations[rows], accrued_reward.take(rows), generator)
        return led

    @property
    def identity(self) -> list[str]:
        """What a checkpoint must share: the driver, and when it drives."""
        settings = self.settings.model_dump(exclude={"driver"})
        return [*self.driver.digests, *(f"{name} = {value}" for name, value in settings.items())]


def check_guides(guides: Sequence[Guide], discount: float) -> None:
    """Refuse several guides of a vehicle, and one that observes rewards which are accrued with another discount."""
    vehicles = sorted(guide.vehicle for guide in guides)
    if len(set(vehicles)) < len(guides):
        raise ValueError(f"a vehicle has several guides: they are for {vehicles}")
    for guide in guides:
        theirs = guide.driver.gamma
        if guide.driver.observes_accrued_reward and np.float32(theirs) != np.float32(discount):
            raise ValueError(f"a guide observes rewards accrued with the discount {theirs:g}; here it is {discount:g}")
