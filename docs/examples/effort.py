"""An objective of one's own: the effort of the engine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mo_deepdrive import Objective, register_objective
from mo_deepdrive.world.limits import limits

if TYPE_CHECKING:
    from mo_deepdrive.world.config import EnvConfig


def effort(vehicles: Any, v: int, params: Any) -> float:
    """Work per mass in the last decision (J/kg): acceleration by the engine times distance."""
    vehicle = vehicles[v]
    seconds = params.dt * params.physics_steps
    distance = abs(vehicle.speed + vehicle.previous_speed) / 2 * seconds
    return float(abs(vehicle.throttle) * distance)


def largest_effort(config: EnvConfig) -> float:
    """The largest magnitude of one decision."""
    limit = limits(config)
    return limit["throttle"] * limit["m/s"] / config.decision_frequency


register_objective(
    Objective(
        name="effort",
        unit="J/kg",
        sign=-1,
        scale=20.0,
        description="work of the engine per mass in the decision",
        bound=largest_effort,
        measure=effort,
        reference=-50.0,
    )
)
