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

from algorithms.learning.checkpoints import strip_prefix

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from algorithms.hyperparameters import GuideSettings
    from mo_deepdrive.evaluation.policy import AccruedReward
    from mo_deepdrive.evaluation.team import Population


class Guide:
    """Drives one vehicle of N environments at the start of some episodes.

    Args:
        driver: what drives.
        settings: when.
        num_envs: N.

    Attributes:
        vehicle: the index of the vehicle.
    """

    def __init__(self, driver: Population, settings: GuideSettings, num_envs: int):
        if len(driver.members) > 1:
            raise ValueError(f"a guide is one driver, not {len(driver.members)} that take turns")
        self.driver = driver
        self.settings = settings
        self.vehicle = driver.vehicle
        self._handover = np.zeros(num_envs, dtype=np.int64)  # decisions after which the learner drives
        self._share = 0.0

    def copy(self) -> Guide:
        """The same for other environments."""
        return Guide(self.driver, self.settings, len(self._handover))

    def begin_rollout(self, progress: float) -> None:
        """Set the share of guided episodes for a rollout at ``progress``, the fraction of the training that is done."""
        self._share = self.settings.share * max(0.0, 1.0 - progress / self.settings.until)

    def drive(
        self,
        actions: NDArray[Any],
        observations: NDArray[np.float32],
        accrued_reward: AccruedReward,
        generator: torch.Generator,
    ) -> NDArray[np.bool_]:
        """Overwrite the vehicle's actions where the guide drives; the mask (N,) of these environments.

        Args:
            actions: (N, V) or (N, V, k) of the learners.
            observations: (N, V, o).
            accrued_reward: of the running episodes.
            generator: draws when the learner takes over, and the actions of a guide that samples.
        """
        decisions = accrued_reward.decisions[:, self.vehicle]
        begin = np.flatnonzero(decisions == 0)
        if len(begin):
            guided, length = torch.rand((2, len(begin)), generator=generator, device=generator.device).cpu().numpy()
            lengths = 1 + (self.settings.decisions * length).astype(np.int64)
            self._handover[begin] = np.where(guided < self._share, lengths, 0)
        led = decisions < self._handover
        rows = np.flatnonzero(led)
        if len(rows):
            actions[rows, self.vehicle] = self.driver.act(observations[rows], accrued_reward.take(rows), generator)
        return led

    def identity(self) -> list[str]:
        """What a checkpoint must share: the driver, and when it drives."""
        settings = self.settings.model_dump(exclude={"driver"})
        return [*self.driver.digests, *(f"{name} = {value}" for name, value in settings.items())]

    def get_state(self) -> dict[str, torch.Tensor]:
        """Where the learner takes over in the running episodes."""
        return {"handover": torch.from_numpy(self._handover.copy())}

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`."""
        self._handover[...] = state["handover"].numpy()


class Guides:
    """The guides of an agent, at most one per vehicle.

    Args:
        guides: of vehicles that learn.
        discount: of the accrued rewards that the agent's policy observes.

    Raises:
        ValueError: if a vehicle has several, or one observes rewards that are accrued with another discount.
    """

    def __init__(self, guides: Sequence[Guide], discount: float):
        self._discount = discount
        self._of_vehicle = {guide.vehicle: guide for guide in guides}
        if len(self._of_vehicle) < len(guides):
            raise ValueError(f"a vehicle has several guides: they are for {sorted(guide.vehicle for guide in guides)}")
        for guide in guides:
            theirs = guide.driver.gamma
            if guide.driver.observes_accrued_reward and np.float32(theirs) != np.float32(discount):
                raise ValueError(
                    f"a guide observes rewards accrued with the discount {theirs:g}; here it is {discount:g}"
                )

    def copy(self) -> Guides:
        """The same for other environments."""
        return Guides([guide.copy() for guide in self], self._discount)

    @property
    def schedules(self) -> list[str]:
        """The settings by which guides depend on the length of the training, as ``name = value``."""
        return [f"training.guides.vehicle_{guide.vehicle}.until = {guide.settings.until}" for guide in self]

    def __iter__(self) -> Iterator[Guide]:
        return iter(self._of_vehicle.values())

    def begin_rollout(self, progress: float) -> None:
        """Set the shares of guided episodes for a rollout at ``progress``."""
        for guide in self:
            guide.begin_rollout(progress)

    def identity(self) -> dict[str, list[str]]:
        """:meth:`Guide.identity` by vehicle."""
        return {f"vehicle_{v}": guide.identity() for v, guide in self._of_vehicle.items()}

    def get_state(self) -> dict[str, torch.Tensor]:
        """:meth:`Guide.get_state` by vehicle."""
        return {
            f"guide_{v}.{name}": tensor
            for v, guide in self._of_vehicle.items()
            for name, tensor in guide.get_state().items()
        }

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`, which may be a part of ``state``."""
        for v, guide in self._of_vehicle.items():
            guide.set_state(strip_prefix(state, f"guide_{v}."))
