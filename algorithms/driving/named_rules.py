"""Scripted drivers by name, in the environments that have some."""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.driving import intersection_rules, roundabout_rules
from algorithms.driving.controls import PREFIX
from algorithms.driving.scripted_policy import ScriptedPolicy
from mo_deepdrive.evaluation.metrics import vehicle_name
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter

MAKERS = {
    env_id: made_by
    for scenario, made_by in (
        ("intersection", intersection_rules.make_rule),
        *((name, roundabout_rules.make_rule) for name in roundabout_rules.ROUNDABOUTS),
    )
    for env_id in SCENARIOS[scenario].ids
}


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
