"""Scripted drivers by name, in the environments that have some, and behind the interface of agents."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.driving import intersection_rules, roundabout_rules
from algorithms.driving.controls import PREFIX
from mo_deepdrive.evaluation.metrics import vehicle_name
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from collections.abc import Callable

    import torch
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.evaluation.policy import AccruedReward

_MAKERS = {"intersection": intersection_rules.make_rule}
_MAKERS |= dict.fromkeys(roundabout_rules.ROUNDABOUTS, roundabout_rules.make_rule)
MAKERS = {env_id: make for scenario, make in _MAKERS.items() for env_id in SCENARIOS[scenario].ids}


class ScriptedPolicy:
    """A policy (:class:`mo_deepdrive.evaluation.policy.Policy`) of which vehicles follow a script, and others idle.

    The driver gives the actions (...) or (..., k), as the environment takes them, for the observations (N, o) of a
    vehicle, or (N, V, o) of all where that is None; without one all idle.
    """

    observes_accrued_reward = False
    utilities = ()
    gamma = 1.0

    def __init__(
        self,
        env: EnvAdapter,
        vehicle: int | None = None,
        driver: Callable[[NDArray[np.float32]], NDArray[Any]] | None = None,
    ):
        self.env, self._vehicle, self._driver = env, vehicle, driver

    @property
    def device(self) -> torch.device:
        """The CPU; scripts draw no random numbers."""
        import torch

        return torch.device("cpu")

    def act(self, observations: NDArray[np.float32], _past: AccruedReward, _generator: Any) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o)."""
        continuous = (self.env.actions,) if self.env.continuous else ()
        actions = np.zeros((len(observations), self.env.vehicles, *continuous), np.float32 if continuous else np.int64)
        if self._driver is not None:
            driven = slice(None) if self._vehicle is None else self._vehicle
            actions[:, driven] = self._driver(observations[:, driven])
        return self.env.policy_actions(actions[:, 0] if self.env.vehicles == 1 else actions)

    def alone(self, vehicle: int) -> ScriptedPolicy:
        """The same of which one vehicle follows the script, so that actions of the others take no time."""
        return ScriptedPolicy(self.env, vehicle, self._driver)


def is_rule(name: str) -> bool:
    """Whether the name is one of a scripted driver."""
    return name.startswith(PREFIX)


def scripted_policy(name: str, vehicle: int, env: EnvAdapter, action_type: str) -> ScriptedPolicy:
    """The scripted driver of a name as a policy that drives ``vehicle`` of ``env``, or all vehicles if it can."""
    if env.name not in MAKERS:
        raise ValueError(f"{name!r}: there are scripted drivers in {', '.join(MAKERS)}, not in {env.name}")
    driver = MAKERS[env.name](name, action_type)
    if driver.vehicle not in (None, vehicle):
        raise ValueError(f"{name!r} drives {vehicle_name(driver.vehicle)}, not {vehicle_name(vehicle)}")
    return ScriptedPolicy(env, driver.vehicle, driver)
