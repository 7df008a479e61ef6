"""The energy that driving takes."""

from __future__ import annotations

from typing import Any

from mo_deepdrive.simulation.jit import jit


@jit
def energy(vehicles: Any, v: int, params: Any) -> float:
    """The positive work of the traction force per mass in the decision (J/kg).

    The throttle is the acceleration that the traction force gives, so its product with the speed is power per mass; the
    speed is the mean of those before and after the decision. Braking recovers nothing.
    """
    vehicle = vehicles[v]
    power = vehicle.throttle * (vehicle.speed + vehicle.previous_speed) / 2
    return float(max(power, 0.0) * params.dt * params.physics_steps)
