"""How long a decision takes, and what an early end leaves of the time limit."""

from __future__ import annotations

from typing import Any

from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import ARRIVED, RUNNING


@jit
def duration(vehicles: Any, v: int, params: Any) -> float:
    """The seconds of a decision; under ``charge_remaining_time`` also those that an end before the arrival leaves."""
    decisions = 1
    if params.charge_remaining_time and vehicles[v].end != RUNNING and vehicles[v].end != ARRIVED:
        decisions += params.max_decisions - vehicles[v].decisions
    return float(params.dt * params.physics_steps * decisions)
