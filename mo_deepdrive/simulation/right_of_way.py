"""Right of way: the braking that who enters forces on those who have it."""

from __future__ import annotations

from mo_deepdrive.simulation import roads
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import LENGTH, RUNNING, Record, Records
from mo_deepdrive.simulation.traffic import MAX_BRAKING, SHORTEST_GAP

# Who entered is entering until the front is this far beyond the point of entry (m).
ENTERING = 2 * LENGTH


@jit
def forced_braking(me: Record, other: Record, speed: float, params: Record) -> float:
    """With how much another vehicle or car with a ``speed`` has to brake (m/s^2) because ``me`` entered ahead of it.

    It is the deceleration rate to avoid a crash, from the gap between its front and the rear of ``me``, along its own
    route, and the difference of the speeds (D. Gettman, L. Head, "Surrogate safety measures from traffic simulation
    models", FHWA-RD-03-050, 2003), with at most MAX_BRAKING; none if it reached its stretch with right of way later.
    """
    if not 0 <= other.entered < me.entered or not roads.is_inside(params, other.route, other.route_distance):
        return 0.0
    joined = params.joins[me.route, other.route]  # NaN where the routes do not join
    joint = params.joins[me.route, me.route]
    gap = joined + me.route_distance - joint - LENGTH - other.route_distance
    closing = speed - me.speed
    if not gap > -LENGTH or closing <= 0.0:  # it does not come there, or is ahead
        return 0.0
    braking: float = min(closing * closing / (2 * max(gap, SHORTEST_GAP)), MAX_BRAKING)
    return braking


@jit
def right_of_way(worlds: Records, i: int, v: int, params: Record) -> float:
    """The most that entering forces anybody with right of way to brake, times the decision's duration (m/s)."""
    me = worlds[i, v]
    most = 0.0
    if me.entered >= 0 and me.route_distance < params.priority[me.route, 0] + ENTERING:
        for k in range(worlds.shape[1]):
            other = worlds[i, k]
            if k != v and other.end == RUNNING:
                most = max(most, forced_braking(me, other, other.speed, params))
        for k in range(len(worlds[i, 0].cars)):
            car = worlds[i, 0].cars[k]
            if car.present:
                most = max(most, forced_braking(me, car, car.speed, params))
    return float(most * params.dt * params.physics_steps)
