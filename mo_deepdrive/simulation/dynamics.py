r"""Motion of one vehicle over one decision: a kinematic bicycle with friction.

Per physics step of length dt, with heading h, heading change per step w, speed v (DeepDrive Zero):

    slip = atan(L_a / (L_a + L_b) * tan(clip(steer, -pi, pi)))
    w'   = (w + dt v / L_b sin(slip)) * 0.95
    v'   = (v + dt throttle) * 0.999 * 0.96^brake
    x'   = x - dt v sin(h - w - slip)
    y'   = y + dt v cos(h - w - slip)
    h'   = h + w'

The original rotates (ahead, side) = dt v (cos(w + slip), sin(w + slip)) by the heading; x' and y' follow from the
addition theorems. h - w is the heading one step ago, whose sine and cosine are known, so one sine and cosine per step
remain. Steer changes by equal parts, so its sine and cosine change by a constant rotation; sin(slip) and cos(slip)
follow from tan(slip) without a function call.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import (
    AXLE_A,
    AXLE_B,
    GRAVITY,
    TOP_SPEED,
    Record,
)
from mo_deepdrive.simulation.trigonometry import sine_cosine

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SLIP_RATIO = AXLE_A / (AXLE_A + AXLE_B)
MAX_STEER_CHANGE = 0.03  # rad per physics step, under constrain_controls
MAX_THROTTLE_CHANGE = 0.04  # m/s^2 per physics step, under constrain_controls

# Columns of the path that `drive` records: the initial pose in row 0, then the pose after each physics step.
PATH_X, PATH_Y, PATH_COS, PATH_SIN, PATH_WIDTH = 0, 1, 2, 3, 4


@jit
def limited(change: float, limit: float) -> float:
    """``change``, clipped to [-limit, limit]."""
    return min(max(change, -limit), limit)


@jit
def drive(
    vehicle: Record, i: int, v: int, controls: NDArray[np.float64], params: Record, path: NDArray[np.float64]
) -> float:
    """Move ``vehicle`` by one decision and record its poses.

    Args:
        vehicle: record of dtype VEHICLE, changed in place.
        i: which world.
        v: which vehicle.
        controls: (worlds, vehicles, 3) target steer (rad), throttle (m/s^2) and brake (1).
        params: record of dtype PARAMS.
        path: (vehicles, physics_steps + 1, 4) buffer for x, y, cos(heading), sin(heading).

    Returns:
        The length of the path (m).
    """
    n = params.physics_steps
    dt = params.dt
    rate = 1.0 / dt
    steer = vehicle.steer
    throttle = vehicle.throttle
    brake = vehicle.brake
    target_brake = 0.0 if params.ignore_brake else controls[i, v, 2]
    if target_brake == 0.0:
        brake = 0.0
    steer_change = controls[i, v, 0] - steer
    throttle_change = controls[i, v, 1] - throttle
    if params.constrain_controls:
        steer_change = limited(steer_change, MAX_STEER_CHANGE * n)
        throttle_change = limited(throttle_change, MAX_THROTTLE_CHANGE * n)
    end_steer = steer + steer_change
    end_throttle = throttle + throttle_change

    # 0.96^brake along the linear ramp of the brake is a geometric sequence.
    drag = params.speed_friction
    drag_change = 1.0
    if brake != 0.0 or target_brake != 0.0:
        drag *= math.exp(brake * params.log_brake_friction)
        drag_change = math.exp((target_brake - brake) / n * params.log_brake_friction)

    clipped = abs(steer) > math.pi or abs(end_steer) > math.pi
    steer_step = steer_change / n
    steer_sin, steer_cos = sine_cosine(steer)
    turn_cos = 1.0
    turn_sin = 0.0
    if steer_step != 0.0 and not clipped:
        turn_sin, turn_cos = sine_cosine(steer_step)

    x = vehicle.x
    y = vehicle.y
    heading = vehicle.heading
    speed = vehicle.speed
    yaw = vehicle.yaw_step
    cos_heading = vehicle.cos_heading
    sin_heading = vehicle.sin_heading
    cos_before = vehicle.cos_before
    sin_before = vehicle.sin_before
    vx = vehicle.vx
    vy = vehicle.vy
    ax = vehicle.ax
    ay = vehicle.ay
    jerk_x = 0.0
    jerk_y = 0.0
    moved = 0.0
    yaw_gain = dt / AXLE_B

    path[v, 0, PATH_X] = x
    path[v, 0, PATH_Y] = y
    path[v, 0, PATH_COS] = cos_heading
    path[v, 0, PATH_SIN] = sin_heading
    for step in range(1, n + 1):
        if clipped:
            clipped_steer = limited(steer + step * steer_step, math.pi)
            steer_sin, steer_cos = sine_cosine(clipped_steer)
        else:
            turned = steer_cos * turn_cos - steer_sin * turn_sin
            steer_sin = steer_sin * turn_cos + steer_cos * turn_sin
            steer_cos = turned
        drag *= drag_change
        push = throttle + step * (throttle_change / n)
        if speed > TOP_SPEED:
            push = 0.0

        # tan(slip) = ratio * tan(steer), cos(slip) >= 0 because atan lies in [-pi/2, pi/2].
        across = SLIP_RATIO * steer_sin
        norm = 1.0 / math.sqrt(across * across + steer_cos * steer_cos)
        slip_cos = abs(steer_cos) * norm
        slip_sin = math.copysign(across * norm, across * steer_cos)

        move = dt * speed
        dx = -move * (sin_before * slip_cos - cos_before * slip_sin)
        dy = move * (cos_before * slip_cos + sin_before * slip_sin)
        x += dx
        y += dy
        yaw = (yaw + yaw_gain * speed * slip_sin) * params.yaw_friction
        speed = (speed + dt * push) * drag
        heading += yaw
        cos_before = cos_heading
        sin_before = sin_heading
        sin_heading, cos_heading = sine_cosine(heading)

        new_vx = dx * rate
        new_vy = dy * rate
        new_ax = (new_vx - vx) * rate
        new_ay = (new_vy - vy) * rate
        jerk_x = (new_ax - ax) * rate
        jerk_y = (new_ay - ay) * rate
        vx = new_vx
        vy = new_vy
        ax = new_ax
        ay = new_ay
        moved += abs(move)
        path[v, step, PATH_X] = x
        path[v, step, PATH_Y] = y
        path[v, step, PATH_COS] = cos_heading
        path[v, step, PATH_SIN] = sin_heading

    vehicle.previous_speed = vehicle.speed
    vehicle.x = x
    vehicle.y = y
    vehicle.heading = heading
    vehicle.speed = speed
    vehicle.yaw_step = yaw
    vehicle.cos_heading = cos_heading
    vehicle.sin_heading = sin_heading
    vehicle.cos_before = cos_before
    vehicle.sin_before = sin_before
    vehicle.vx = vx
    vehicle.vy = vy
    vehicle.ax = ax
    vehicle.ay = ay
    vehicle.g_force = math.sqrt(ax * ax + ay * ay) / GRAVITY
    vehicle.jerk = math.sqrt(jerk_x * jerk_x + jerk_y * jerk_y)
    vehicle.steer = end_steer
    vehicle.throttle = end_throttle
    vehicle.brake = target_brake
    vehicle.travelled += moved
    return moved
