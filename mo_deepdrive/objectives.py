"""The objectives: unit, sign and nominal scale of each.

The kernel measures *magnitudes* (a g-force of 0.2, a collision of 1). The environments return rewards to be
maximised: magnitude times sign. ``cost_sign="paper"`` returns the magnitudes themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Objective:
    """One objective of the benchmark.

    Attributes:
        name: the name in configurations and logs.
        unit: SI unit of the magnitude per decision.
        sign: +1 if more is better, -1 for a cost.
        scale: nominal magnitude of the *return* of an episode, by which learners divide.
        description: what the magnitude measures.
    """

    name: str
    unit: str
    sign: int
    scale: float
    description: str


OBJECTIVES: tuple[Objective, ...] = (
    Objective("distance", "m", +1, 10.0, "route distance gained in the decision"),
    Objective("destination", "1", +1, 1.0, "1 on the decision that arrives"),
    Objective("g_force", "g", -1, 5.0, "acceleration at the end of the decision"),
    Objective("collision", "1", -1, 1.0, "1 on the decision that collides"),
    Objective("jerk", "m/s^3", -1, 500.0, "jerk at the end of the decision"),
    Objective("lane_violation", "m", -1, 10.0, "metres outside the lane at the end of the decision"),
)
NAMES: tuple[str, ...] = tuple(objective.name for objective in OBJECTIVES)
INDEX: dict[str, int] = {name: index for index, name in enumerate(NAMES)}


def signs(names: tuple[str, ...]) -> NDArray[np.float64]:
    """Sign of each named objective, shape (d,): reward = sign * magnitude under ``cost_sign="maximise"``."""
    return np.array([OBJECTIVES[INDEX[name]].sign for name in names], dtype=np.float64)


def scales(names: tuple[str, ...]) -> NDArray[np.float64]:
    """Nominal scale of the return of each named objective, shape (d,)."""
    return np.array([OBJECTIVES[INDEX[name]].scale for name in names], dtype=np.float64)
