"""Cross-play: every driver of vehicle 0 with every driver of vehicle 1, most of which have never met.

Policies that have trained together may rely on each other's habits; what they are worth with strangers is seen off the
diagonal (Hu et al. 2020, "'Other-Play' for zero-shot coordination").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.metrics import COLLISION, SUCCESS, UTILITY_ESR, end_by, vehicle_prefix
from mo_deepdrive.evaluation.statistics import Estimate, mean, rate
from mo_deepdrive.evaluation.team import Team

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from mo_deepdrive.evaluation.episodes import UtilityLike
    from mo_deepdrive.evaluation.policy import Policy
    from mo_deepdrive.evaluation.splits import Split

ROLES = 2  # vehicles
ARRIVALS, COLLISIONS = SUCCESS, end_by(COLLISION)
# The scores of an encounter, in order.
SCORES = (
    ARRIVALS,
    COLLISIONS,
    *(f"{vehicle_prefix(v, ROLES)}{name}" for name in (SUCCESS, UTILITY_ESR) for v in range(ROLES)),
)


@dataclass(frozen=True)
class Encounter:
    """What two drivers achieve together.

    Attributes:
        drivers: name of the driver of vehicle 0, and of that of vehicle 1.
        estimates: SCORES with their 95% intervals over the episodes: "success" is the share of episodes in which both
            arrive, "end/collision" of those with a collision.
    """

    drivers: tuple[str, str]
    estimates: dict[str, Estimate]


def cross_play(
    drivers: Sequence[Mapping[str, Policy]],
    env_id: str,
    *,
    utility: UtilityLike,
    split: Split | None = None,
    episodes: int = 200,
    seed: int | None = None,
    greedy: bool = False,
    env_kwargs: Mapping[str, Any] | None = None,
    progress: Callable[[], None] | None = None,
) -> list[Encounter]:
    """Let every driver of vehicle 0 drive with every driver of vehicle 1, on the same scenarios.

    Args:
        drivers: for each of the two vehicles its drivers by name.
        env_id: an environment of two vehicles.
        utility: by which both vehicles are judged, whatever their drivers maximised.
        split: the scenarios: "validation" (default), or "test" for final scores.
        episodes: of every encounter.
        seed: of the first episode, instead of a split.
        greedy: take the most likely (or mean) actions instead of sampling.
        env_kwargs: arguments of the environment.
        progress: called after every encounter.

    Returns:
        The encounters, those of the first driver of vehicle 0 first.

    Raises:
        ValueError: for invalid arguments, or drivers that do not drive in the environment.
    """
    if len(drivers) != ROLES or not all(drivers):
        raise ValueError(f"drivers must be those of {ROLES} vehicles, at least one each")
    found = []
    for first, one in drivers[0].items():
        for second, other in drivers[1].items():
            result = evaluate(
                Team([one, other]),
                env_id,
                split=split,
                episodes=episodes,
                seed=seed,
                utility=utility,
                env_kwargs=env_kwargs,
                greedy=greedy,
            )
            collided = np.array([COLLISION in ends for ends in result.ends.tolist()])
            by_vehicle = [rate(result.succeeded[:, v]) for v in range(ROLES)]
            by_vehicle += [mean(result.episode_utilities(v)) for v in range(ROLES)]
            estimates = [rate(np.asarray(result.succeeded.all(axis=1))), rate(collided), *by_vehicle]
            found.append(Encounter((first, second), dict(zip(SCORES, estimates, strict=True))))
            if progress is not None:
                progress()
    return found
