"""The energy that driving takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mo_deepdrive.simulation.jit import jit

if TYPE_CHECKING:
    from mo_deepdrive.simulation.state import Record, Records


@jit
def energy(worlds: Records, i: int, v: int, params: Record) -> float:
    """The positive work of the traction force per mass in the decision (J/kg).

    The throttle is the acceleration that the traction force gives, so its product with the speed is power per mass; the
    speed is the mean of those before and after the decision. Braking recovers nothing.
    """
    vehicle = worlds[i, v]
    power = vehicle.throttle * (vehicle.speed + vehicle.previous_speed) / 2
    return float(max(power, 0.0) * params.dt * params.physics_steps)
