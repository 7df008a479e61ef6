"""How long a decision takes, and what an early end leaves of the time limit."""

from __future__ import annotations

from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import ARRIVED, RUNNING, Record, Records


@jit
def duration(worlds: Records, i: int, v: int, params: Record) -> float:
    """The seconds of a decision; under ``charge_remaining_time`` also those that an end before the arrival leaves."""
    vehicle = worlds[i, v]
    decisions = 1
    if params.charge_remaining_time and vehicle.end != RUNNING and vehicle.end != ARRIVED:
        decisions += params.max_decisions - vehicle.decisions
    return float(params.dt * params.physics_steps * decisions)
