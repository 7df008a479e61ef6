"""Types of hyperparameters: what each kind of number may be, checked when a config is parsed."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field


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
