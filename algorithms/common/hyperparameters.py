"""Types of hyperparameters: what each kind of number may be, checked when a config is parsed; settings of networks."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, SerializerFunctionWrapHandler, model_serializer

from mo_deepdrive.config import Settings


def _positive_sizes(hidden: list[int]) -> list[int]:
    if any(size < 1 for size in hidden):
        raise ValueError("layer sizes must be positive")
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
HiddenSizes = Annotated[list[int], Field(min_length=1), AfterValidator(_positive_sizes)]
Scales = Annotated[list[float], AfterValidator(_positive_scales)]
Activation = Literal["relu", "tanh", "elu", "gelu", "silu", "leaky_relu"]
DottedPath = Annotated[str, Field(pattern=r"^[^:]+:[^:]+$")]


class NetworkSettings(Settings):
    """Hyperparameters of networks, the base of every Config whose algorithm uses :mod:`algorithms.common.networks`.

    Attributes:
        hidden: sizes of the hidden layers.
        activation: the function between the layers.
        network: "package.module:function" of a function that makes the networks instead, called as
            ``function(inputs, outputs, generator)``; ``hidden`` and ``activation`` are not used then.
    """

    hidden: HiddenSizes = [64, 32]
    activation: Activation = "relu"
    network: DottedPath | None = None

    @model_serializer(mode="wrap")
    def _without_new_defaults(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what earlier versions did not have, so that their runs and sweeps remain the same experiments."""
        values: dict[str, Any] = dump(self)
        new = {"activation": "relu", "network": None, "utility_scale": 10.0}
        return {key: value for key, value in values.items() if key not in new or value != new[key]}


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
