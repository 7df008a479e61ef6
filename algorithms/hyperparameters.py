"""Types of hyperparameters: what each kind of number may be, checked when a config is parsed; shared settings."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from mo_deepdrive.config import Settings

LARGEST_LAYER = 16_384


def _positive_sizes(hidden: list[int]) -> list[int]:
    if not all(1 <= size <= LARGEST_LAYER for size in hidden):
        raise ValueError(f"layer sizes must be between 1 and {LARGEST_LAYER}")
    return hidden


def _positive_scales(scales: list[float]) -> list[float]:
    if any(scale <= 0.0 for scale in scales):
        raise ValueError("scales must be positive")
    return scales


LearningRate = Annotated[float, Field(gt=0.0, le=1.0)]
FinalLearningRate = Annotated[float, Field(ge=0.0, le=1.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
PositiveFraction = Annotated[float, Field(gt=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(ge=1, le=4096)]
HiddenSizes = Annotated[list[int], Field(min_length=1, max_length=32), AfterValidator(_positive_sizes)]
Scales = Annotated[list[float], AfterValidator(_positive_scales)]
Activation = Literal["relu", "tanh", "elu", "gelu", "silu", "leaky_relu"]
DottedPath = Annotated[str, Field(pattern=r"^[^:]+:[^:]+$")]


def a_twentieth(total_timesteps: int) -> int:
    """The default of environment steps between evaluations, and between checkpoints, of a training."""
    return max(1, total_timesteps // 20)


class NetworkSettings(Settings):
    """Hyperparameters of networks, the base of every Config whose algorithm uses :mod:`algorithms.networks.modules`."""

    hidden: HiddenSizes = [64, 32]
    """Sizes of the hidden layers."""
    activation: Activation = "relu"
    """The function between the layers."""
    network: DottedPath | None = None
    """Path "package.module:function" of a function that makes the networks instead, called as ``function(inputs,
    outputs, generator)``; ``hidden`` and ``activation`` are not used then."""
    state_dependent_std: bool = False
    """Whether the standard deviations of continuous actions are outputs of the network, or one number per axis for all
    states."""

    def identity(self, *, continuous: bool) -> dict[str, Any]:
        """What two agents must share to have networks alike, for the identity of a checkpoint."""
        return {
            "hidden": list(self.hidden),
            "activation": self.activation,
            "network": self.network,
            "state_dependent_std": continuous and self.state_dependent_std,
        }


class ActorCriticSettings(NetworkSettings):
    """Hyperparameters that all algorithms of :mod:`algorithms.actor_critic` have beside those of NetworkSettings."""

    cost_growth: Fraction = 0.0
    """Fraction of the training in which costs, the objectives whose rewards are never positive, grow from 0 to their
    full size in what is learnt from; 0 for none. It is a curriculum: who is punished from the first step on may learn
    to stand still before the first arrival."""


class GuideSettings(Settings):
    """When a guide (:mod:`algorithms.rollouts.guides`) begins episodes of a vehicle that learns."""

    driver: Annotated[str, Field(min_length=1)]
    """A run, a policy of the zoo or a scripted driver."""
    share: PositiveFraction = 0.5
    """Share of the episodes that begin with the guide at the start of the training."""
    until: PositiveFraction = 0.5
    """Fraction of the training after which no episode does; the share falls linearly to 0."""
    decisions: Count = 160
    """Most decisions of the guide in an episode; their number is drawn uniformly from 1 on."""


def schedules(config: Settings) -> list[str]:
    """The hyperparameters by which training depends on its length, as ``name = value``.

    Args:
        config: with the names that schedules have in this package's algorithms.
    """
    values = config.model_dump()
    found = []
    if values.get("learning_rate_end") not in (None, values.get("learning_rate")):
        found.append("learning_rate_end")
    if values.get("entropy_end") != values.get("entropy_start"):
        found.append("entropy_end")
    if values.get("cost_growth"):
        found.append("cost_growth")
    return [f"algorithm.{name} = {values[name]}" for name in found]


def check_entropy_schedule(entropy_start: float, entropy_end: float) -> None:
    """Refuse a geometric schedule from or to zero.

    Raises:
        ValueError: unless both ends are positive or both are zero.
    """
    if (entropy_start == 0.0) != (entropy_end == 0.0):
        raise ValueError(
            f"entropy_start = {entropy_start} and entropy_end = {entropy_end} must both be positive "
            "or both be 0: the coefficient moves geometrically between them"
        )


def check_discounts(advantage: str, gamma: float, accrued_gamma: float) -> None:
    """Refuse increases of the utility that count the more, the later they come.

    Raises:
        ValueError: for "expected_utility" with a gamma above g.
    """
    if advantage == "expected_utility" and gamma > accrued_gamma:
        raise ValueError(
            f"gamma = {gamma} must be at most accrued_gamma = {accrued_gamma} with advantage = {advantage!r}"
        )
