"""Types of hyperparameters: what each kind of number may be, checked when a config is parsed; shared settings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, model_validator

from mo_deepdrive.world.config import Settings

if TYPE_CHECKING:
    from typing_extensions import Self

LearningRate = Annotated[float, Field(gt=0.0, le=1.0)]
FinalLearningRate = Annotated[float, Field(ge=0.0, le=1.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
PositiveFraction = Annotated[float, Field(gt=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(ge=1, le=4096)]
HiddenSizes = Annotated[list[Annotated[int, Field(ge=1, le=16_384)]], Field(min_length=1, max_length=32)]
Scales = list[Positive]
Activation = Literal["relu", "tanh", "elu", "gelu", "silu", "leaky_relu"]
DottedPath = Annotated[str, Field(pattern=r"^[^:]+:[^:]+$")]


def a_twentieth(total_timesteps: int) -> int:
    """The default of environment steps between evaluations, and between checkpoints, of a training."""
    return max(1, total_timesteps // 20)


class NetworkSettings(Settings):
    """Hyperparameters of networks, the base of every Config with networks of :mod:`algorithms.learning`."""

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
    """Hyperparameters of all algorithms of :mod:`algorithms.actor_critic`, beside those of NetworkSettings."""

    learning_rate: LearningRate = 1e-3
    """Adam's step size at the start of training."""
    learning_rate_end: FinalLearningRate | None = None
    """Adam's step size at the end, to which it moves linearly; None for a constant one."""
    gamma: Fraction = 0.99
    """Discount."""
    gae_lambda: Fraction = 0.95
    """lambda of the advantages; 0 gives one-step advantages, 1 uses the whole rollout."""
    steps: Count = 16
    """T, time steps per environment and update."""
    entropy_start: NonNegative = 0.01
    """c_e at the start of training."""
    entropy_end: NonNegative = 0.01
    """c_e at the end, to which it moves geometrically."""
    entropy_until: PositiveFraction = 1.0
    """Fraction of the training after which c_e is ``entropy_end``."""
    value_coefficient: Positive = 0.5
    """c_v."""
    max_grad_norm: Positive = 0.5
    """Maximum norm of the gradient."""
    normalise_advantages: bool = True
    """Normalise the advantages of a rollout to mean 0 and standard deviation 1."""
    objective_scales: Scales | None = None
    """Nominal size of each objective's return; None for the environment's own."""
    centralised_critic: bool = False
    """The critic also sees the observations of the other vehicles; the actor does not."""
    cost_growth: Fraction = 0.0
    """Fraction of the training in which costs, the objectives whose rewards are never positive, grow from 0 to their
    full size in what is learnt from; 0 for none. It is a curriculum: who is punished from the first step on may learn
    to stand still before the first arrival."""
    cost_growth_power: Positive = 1.0
    """Power of the share of ``cost_growth`` that has passed, by which costs are multiplied; above 1 they are low for
    longer."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.entropy_start == 0.0) != (self.entropy_end == 0.0):
            raise ValueError(
                f"entropy_start = {self.entropy_start} and entropy_end = {self.entropy_end} must both be positive "
                "or both be 0: the coefficient moves geometrically between them"
            )
        return self


class ProximalSettings(ActorCriticSettings):
    """Hyperparameters of PPO and its relatives."""

    epochs: Annotated[int, Field(ge=1, le=100)] = 4
    """Passes over every rollout."""
    minibatches: Count = 4
    """Gradient steps per pass."""
    clip: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.2
    """epsilon, by which pi / pi_old may differ from 1 before a sample no longer counts."""


class AccruedSettings(ActorCriticSettings):
    """Hyperparameters of algorithms whose utility judges the accrued reward and what is to come."""

    advantage: Literal["utility_difference", "as_printed", "utility_gradient", "expected_utility"] = (
        "utility_difference"
    )
    """How A_t is calculated, by the difference of utilities, as printed in the paper, by the gradient of u, or by the
    increases of u."""
    accrued_discount: PositiveFraction | None = None
    """g, discount of the accrued reward; None for gamma, as in the paper. With "expected_utility" gamma is at most g,
    and gamma / g is the discount of the increases of u."""
    observe_accrued: bool = True
    """Include R_t in the state, as the theory requires; without it the policy ignores the past."""
    observe_discount: bool = True
    """Include g^t in the state, on which A_t depends too."""
    utility_scale: Positive = 10.0
    """Nominal size of the utility of a return, for the critic of "expected_utility"."""

    @property
    def g(self) -> float:
        """g: ``accrued_discount``, or gamma where that is None."""
        return self.gamma if self.accrued_discount is None else self.accrued_discount

    @property
    def accrued_ratio(self) -> float:
        """``gamma / g``, which is 1 where both are 0."""
        return 1.0 if self.gamma == self.g else self.gamma / self.g

    @model_validator(mode="after")
    def _discounts(self) -> Self:
        if self.advantage == "expected_utility" and self.gamma > self.g:
            raise ValueError(
                f"gamma = {self.gamma} must be at most accrued_discount = {self.g} with advantage = {self.advantage!r}"
            )
        return self


class GuideSettings(Settings):
    """When a guide (:mod:`algorithms.learning.guides`) begins episodes of a vehicle that learns."""

    driver: Annotated[str, Field(min_length=1)]
    """A run, a policy of the zoo or a scripted driver."""
    share: PositiveFraction = 0.5
    """Share of the episodes that begin with the guide at the start of the training."""
    until: PositiveFraction = 0.5
    """Fraction of the training after which no episode does; the share falls linearly to 0."""
    decisions: Count = 160
    """Most decisions of the guide in an episode; their number is drawn uniformly from 1 on."""


def linear_schedule(start: float, end: float | None, progress: float) -> float:
    """The value at ``progress`` in [0, 1] on the line from ``start`` to ``end``; ``start`` if ``end`` is None."""
    return start if end is None else start + (end - start) * min(1.0, progress)


def geometric_schedule(start: float, end: float, progress: float) -> float:
    """The value at ``progress`` in [0, 1] between ``start`` and ``end``, by a constant factor; 0 if ``start`` is 0."""
    return 0.0 if start == 0.0 else start * (end / start) ** min(1.0, progress)


def schedules(config: Settings) -> list[str]:
    """The hyperparameters by which training depends on its length, as ``name = value``, by their usual names."""
    values = config.model_dump()
    moving = {
        "learning_rate_end": values.get("learning_rate_end") not in (None, values.get("learning_rate")),
        "entropy_end": values.get("entropy_end") != values.get("entropy_start"),
        "cost_growth": values.get("cost_growth"),
    }
    return [f"algorithm.{name} = {values[name]}" for name, moves in moving.items() if moves]
