"""Cross-play: every driver of one vehicle with every driver of the others, most of which have never met.

Policies that have trained together may rely on each other's habits; what they are worth with strangers is seen off the
diagonal (Hu et al. 2020, "'Other-Play' for zero-shot coordination"). With drivers of several preferences it shows what
each gets among its own kind and among the others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.metrics import SUCCESS, UTILITY_ESR, return_of, vehicle_name
from mo_deepdrive.evaluation.statistics import Estimate, mean, rate
from mo_deepdrive.evaluation.team import Team

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.episodes import UtilityLike
    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.policy import Policy
    from mo_deepdrive.evaluation.splits import Split

OTHERS = "others"


def roles_of(vehicles: int) -> tuple[str, str]:
    """The two roles: vehicle 0, and vehicle 1 or, if there are more, all others."""
    return vehicle_name(0), vehicle_name(1) if vehicles == 2 else OTHERS


@dataclass(frozen=True)
class Encounter:
    """What two drivers achieve together."""

    drivers: tuple[str, str]  #: name of the driver of vehicle 0, and of that of all others
    #: With their 95% intervals over the episodes, those of all together (``Evaluation.team_samples``), such as
    #: "success", the share of episodes in which all arrive; then arrivals and utility of both roles, such as
    #: "vehicle_0/success", which for several others are means over them; and the returns of vehicle 0.
    estimates: dict[str, Estimate]

    @property
    def roles(self) -> tuple[str, ...]:
        """The names of the two roles, as of :func:`roles_of`."""
        end = f"/{SUCCESS}"
        return tuple(name.removesuffix(end) for name in self.estimates if name.endswith(end))


def cross_play(
    drivers: Sequence[Mapping[str, Policy]],
    env_id: str,
    *,
    utility: UtilityLike | Mapping[str, UtilityLike],
    split: Split | None = None,
    episodes: int = 200,
    seed: int | None = None,
    greedy: bool = False,
    env_kwargs: Mapping[str, Any] | None = None,
    progress: Callable[[], None] = lambda: None,
) -> list[Encounter]:
    """Let every driver of vehicle 0 drive with every driver of all other vehicles, on the same scenarios.

    The drivers are those of vehicle 0 by name, and those of the others, of which one drives all of them at a time. The
    utility judges all vehicles, whatever their drivers maximised; there may be one for every driver by name. After
    every encounter ``progress`` is called; the other arguments are those of :func:`mo_deepdrive.evaluation.evaluate`.
    Returns the encounters, those of the first driver of vehicle 0 first. A ValueError for drivers that do not drive in
    the environment.
    """
    if len(drivers) != 2 or not all(drivers):
        raise ValueError("drivers must be those of vehicle 0 and those of the others, at least one each")

    def utility_of(name: str) -> UtilityLike:
        return utility[name] if isinstance(utility, Mapping) else utility

    meet = partial(evaluate, split=split, episodes=episodes, seed=seed, env_kwargs=env_kwargs, greedy=greedy)
    encounters = []
    for (first, one), (second, other) in product(drivers[0].items(), drivers[1].items()):
        others = one.env.vehicles - 1
        utilities = [utility_of(first)] + [utility_of(second)] * others
        result = meet(Team([one, other], [0] + [1] * others), env_id, utility=utilities)
        encounters.append(Encounter((first, second), _estimates(result)))
        progress()
    return encounters


def _estimates(result: Evaluation) -> dict[str, Estimate]:
    vehicles = result.returns.shape[1]
    estimates = {name: _mean(samples) for name, samples in result.team_samples().items()}
    utilities = np.stack([result.episode_utilities(v) for v in range(vehicles)], axis=1)
    for name, samples in ((SUCCESS, result.succeeded), (UTILITY_ESR, utilities)):
        for role, part in zip(roles_of(vehicles), (samples[:, 0], samples[:, 1:]), strict=True):
            alone = part.ndim == 1 or part.shape[1] == 1
            estimates[f"{role}/{name}"] = _mean(part.reshape(-1) if alone else part.mean(axis=1))
    for i, objective in enumerate(result.objectives):
        estimates[f"{vehicle_name(0)}/{return_of(objective)}"] = mean(result.returns[:, 0, i])
    return estimates


def _mean(samples: NDArray[Any]) -> Estimate:
    return rate(samples) if samples.dtype == np.bool_ else mean(samples)
