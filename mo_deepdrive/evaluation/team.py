"""Several policies as one, that drive some of the vehicles each or take turns, and what vehicles are worth together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.evaluation.policy import check_same_task

if TYPE_CHECKING:
    from collections.abc import Sequence

    import torch
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.evaluation.policy import AccruedReward, Policy
    from mo_deepdrive.utilities import Utility

    Floats = NDArray[np.float64]


class Team:
    """A policy that drives each vehicle as one of its members does, each of which acts for all vehicles.

    ``seats`` are the indices of the members that drive the vehicles; by default the v-th one drives vehicle v. A
    ValueError if seats and vehicles are not equally many, or the members' environments differ.
    """

    def __init__(self, members: Sequence[Policy], seats: Sequence[int] | None = None):
        self.env: EnvAdapter = members[0].env
        self.seats = tuple(range(len(members)) if seats is None else seats)
        if len(self.seats) != self.env.vehicles:
            raise ValueError(f"{len(self.seats)} members for {self.env.vehicles} vehicles")
        for member in members[1:]:
            check_same_task(member.env, self.env)
        self.members = tuple(
            _driving(member, {v for v, seat in enumerate(self.seats) if seat == k}) for k, member in enumerate(members)
        )

    @property
    def utilities(self) -> tuple[Utility, ...]:
        """Those of the members, each for its own vehicle; empty if one of them has none."""
        if not all(member.utilities for member in self.members):
            return ()
        return tuple(self.members[seat].utilities[v] for v, seat in enumerate(self.seats))

    @property
    def gamma(self) -> NDArray[np.float32]:
        """(V,) discount factors of the accrued rewards that the members observe."""
        return np.array([_gamma_of(self.members[seat], v) for v, seat in enumerate(self.seats)], dtype=np.float32)

    @property
    def device(self) -> torch.device:
        """That of the first member."""
        return self.members[0].device

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o); greedy if ``generator`` is None."""
        acted = [member.act(observations, accrued_reward, generator) for member in self.members]
        return np.stack([acted[seat][:, v] for v, seat in enumerate(self.seats)], axis=1)


class Population:
    """Policies that take turns as the driver of one vehicle: environment n is driven by member n modulo their number.

    So every member has the same share of the environments, and which one drives is no part of the state of a run. What
    members observe of the accrued reward has one discount, ``gamma``; ``digests`` identify them for checkpoints. A
    ValueError if there is no member, their environments differ, or they observe differently discounted rewards.
    """

    def __init__(self, members: Sequence[Policy], vehicle: int, digests: Sequence[str] = ()):
        if not members:
            raise ValueError(f"there is no driver of vehicle {vehicle}")
        for member in members[1:]:
            check_same_task(member.env, members[0].env)
        observed = [member for member in members if getattr(member, "observes_accrued_reward", True)]
        self.observes_accrued_reward = bool(observed)
        # As rewards are accrued, in single precision.
        gammas = {np.float32(_gamma_of(member, vehicle)) for member in observed}
        if len(gammas) > 1:
            texts = ", ".join(f"{gamma:g}" for gamma in sorted(gammas))
            raise ValueError(f"drivers of vehicle {vehicle} observe rewards accrued with different discounts: {texts}")
        self.members = tuple(members)
        self.vehicle = vehicle
        self.digests = tuple(digests)
        self.gamma = _gamma_of(observed[0], vehicle) if observed else 1.0

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N,) or (N, k) of the vehicle for observations (N, V, o); greedy if ``generator`` is None."""
        parts = []
        for k, member in enumerate(self.members[: len(observations)]):
            rows = np.arange(k, len(observations), len(self.members))
            parts.append((rows, member.act(observations[rows], accrued_reward.take(rows), generator)[:, self.vehicle]))
        first = parts[0][1]
        actions = np.empty((len(observations), *first.shape[1:]), dtype=first.dtype)
        for rows, part in parts:
            actions[rows] = part
        return actions


def _driving(policy: Any, vehicles: set[int]) -> Policy:
    """The policy, without its partners if others drive the vehicles of these."""
    partners = getattr(policy, "partners", {})
    return policy.without_partners() if partners and vehicles.isdisjoint(partners) else policy  # type: ignore[no-any-return]


def _gamma_of(policy: Policy, vehicle: int) -> float:
    """The discount of the accrued reward that a policy observes of a vehicle."""
    return float(np.broadcast_to(policy.gamma, policy.env.vehicles)[vehicle])


# Three ways of adding up the utilities of several vehicles, which MAPPO can maximise, too.


def total(utilities: Floats) -> Floats:
    """(...) the sum of utilities (..., V): nobody counts for more than another."""
    return np.asarray(np.sum(utilities, axis=-1))


def worst_off(utilities: Floats) -> Floats:
    """(...) the least of utilities (..., V)."""
    return np.asarray(np.min(utilities, axis=-1))


def generalised_gini(utilities: Floats) -> Floats:
    """(...) the sum of 2^-k u_k over the utilities u_1 <= u_2 <= ... (..., V), from the worst-off on.

    A gain counts for more where it goes to somebody worse off (J. A. Weymark, "Generalized Gini inequality indices",
    Mathematical Social Sciences 1, 1981).
    """
    return np.asarray(np.sort(utilities, axis=-1) @ 0.5 ** np.arange(1, np.shape(utilities)[-1] + 1))
