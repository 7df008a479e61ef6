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

Worlds move side by side in lanes (see ``lanes.py``), so the innermost loop runs over the lanes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import (
    AXLE_A,
    AXLE_B,
    GRAVITY,
    RUNNING,
    TOP_SPEED,
    Record,
    Records,
    in_lanes,
)
from mo_deepdrive.simulation.trigonometry import sine_cosine

if TYPE_CHECKING:
    from numpy.typing import NDArray

SLIP_RATIO = AXLE_A / (AXLE_A + AXLE_B)
MAX_STEER_CHANGE = 0.03  # rad per physics step, under constrain_controls
MAX_THROTTLE_CHANGE = 0.04  # m/s^2 per physics step, under constrain_controls

# What changes within a decision, besides the pose; the units are those of VEHICLE.
MOTION = in_lanes(
    *("heading", "speed", "yaw_step", "vx", "vy", "ax", "ay", "jerk_x", "jerk_y", "cos_before", "sin_before"),
    *("steer", "steer_step", "end_steer", "cos_steer", "sin_steer", "cos_turn", "sin_turn"),
    *("throttle", "throttle_step", "end_throttle", "end_brake", "drag", "drag_change"),
)
# One row of a path: the pose after a physics step, or before the first one, and the length of the path up to there (m).
POSE = in_lanes("x", "y", "cos", "sin", "moved")


def make_scratch(bodies: int, physics_steps: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """The scratch buffers of :func:`drive`: motion (1,) of MOTION and path (bodies, physics_steps + 1) of POSE.

    Bodies are the vehicles and, after them, the oncoming cars.
    """
    return np.zeros(1, dtype=MOTION), np.zeros((bodies, physics_steps + 1), dtype=POSE)


@jit
def limited(change: float, limit: float) -> float:
    """``change``, clipped to [-limit, limit]."""
    return min(max(change, -limit), limit)


@jit
def load(
    vehicle: Record, i: int, v: int, controls: NDArray[np.float64], params: Record, lane: int, m: Record, pose: Record
) -> None:
    """Copy a vehicle to a lane, and divide the change of its controls into physics steps."""
    n = params.physics_steps
    brake = vehicle.brake
    target_brake = 0.0 if params.ignore_brake else controls[i, v, 2]
    if target_brake == 0.0:
        brake = 0.0
    steer_change = controls[i, v, 0] - vehicle.steer
    throttle_change = controls[i, v, 1] - vehicle.throttle
    if params.constrain_controls:
        steer_change = limited(steer_change, MAX_STEER_CHANGE * n)
        throttle_change = limited(throttle_change, MAX_THROTTLE_CHANGE * n)
    m.steer[lane] = vehicle.steer
    m.steer_step[lane] = steer_change / n
    m.end_steer[lane] = vehicle.steer + steer_change
    m.throttle[lane] = vehicle.throttle
    m.throttle_step[lane] = throttle_change / n
    m.end_throttle[lane] = vehicle.throttle + throttle_change
    m.end_brake[lane] = target_brake

    # 0.96^brake along the linear ramp of the brake is a geometric sequence.
    drag = params.speed_friction
    drag_change = 1.0
    if brake != 0.0 or target_brake != 0.0:
        drag *= math.exp(brake * params.log_brake_friction)
        drag_change = math.exp((target_brake - brake) / n * params.log_brake_friction)
    m.drag[lane] = drag
    m.drag_change[lane] = drag_change

    m.heading[lane] = vehicle.heading
    m.speed[lane] = vehicle.speed
    m.yaw_step[lane] = vehicle.yaw_step
    m.cos_before[lane] = vehicle.cos_before
    m.sin_before[lane] = vehicle.sin_before
    m.vx[lane] = vehicle.vx
    m.vy[lane] = vehicle.vy
    m.ax[lane] = vehicle.ax
    m.ay[lane] = vehicle.ay
    pose.x[lane] = vehicle.x
    pose.y[lane] = vehicle.y
    pose.cos[lane] = vehicle.cos_heading
    pose.sin[lane] = vehicle.sin_heading
    pose.moved[lane] = 0.0


@jit
def store(vehicle: Record, lane: int, m: Record, pose: Record) -> None:
    """Copy a lane to its vehicle."""
    vehicle.previous_speed = vehicle.speed
    vehicle.x = pose.x[lane]
    vehicle.y = pose.y[lane]
    vehicle.cos_heading = pose.cos[lane]
    vehicle.sin_heading = pose.sin[lane]
    vehicle.travelled += pose.moved[lane]
    vehicle.heading = m.heading[lane]
    vehicle.speed = m.speed[lane]
    vehicle.yaw_step = m.yaw_step[lane]
    vehicle.cos_before = m.cos_before[lane]
    vehicle.sin_before = m.sin_before[lane]
    vehicle.vx = m.vx[lane]
    vehicle.vy = m.vy[lane]
    vehicle.ax = m.ax[lane]
    vehicle.ay = m.ay[lane]
    vehicle.g_force = math.sqrt(m.ax[lane] * m.ax[lane] + m.ay[lane] * m.ay[lane]) / GRAVITY
    vehicle.jerk = math.sqrt(m.jerk_x[lane] * m.jerk_x[lane] + m.jerk_y[lane] * m.jerk_y[lane])
    vehicle.steer = m.end_steer[lane]
    vehicle.throttle = m.end_throttle[lane]
    vehicle.brake = m.end_brake[lane]


@jit
def clip_steer(m: Record, lanes: int, step: int) -> None:
    """Set the steer after ``step`` physics steps of those lanes where it begins or ends beyond pi."""
    for lane in range(lanes):
        if abs(m.steer[lane]) > math.pi or abs(m.end_steer[lane]) > math.pi:
            steer = limited(m.steer[lane] + step * m.steer_step[lane], math.pi)
            m.sin_steer[lane], m.cos_steer[lane] = sine_cosine(steer)


@jit
def drive(
    worlds: Records, first: int, last: int, v: int, controls: NDArray[np.float64], params: Record,
    motion: Records, path: Records,
) -> None:  # fmt: skip
    """Move vehicle ``v`` of the worlds ``first`` to ``last`` - 1 by one decision and record its poses.

    Args:
        worlds: (worlds, vehicles) of VEHICLE, changed in place; vehicles that have ended stay as they are.
        first: the world in lane 0.
        last: the world after the last one, at most ``first`` + LANES.
        v: which vehicle.
        controls: (worlds, vehicles, 3) target steer (rad), throttle (m/s^2) and brake (1).
        params: record of dtype PARAMS.
        motion: (1,) of MOTION, scratch.
        path: (vehicles + cars, physics_steps + 1) of POSE; the row of the vehicle is written.
    """
    n = params.physics_steps
    dt = params.dt
    rate = 1.0 / dt
    yaw_gain = dt / AXLE_B
    yaw_friction = params.yaw_friction
    lanes = last - first
    m = motion[0]
    clipped = False
    for lane in range(lanes):
        load(worlds[first + lane, v], first + lane, v, controls, params, lane, m, path[v, 0])
        clipped = clipped or abs(m.steer[lane]) > math.pi or abs(m.end_steer[lane]) > math.pi
    for lane in range(lanes):
        m.sin_steer[lane], m.cos_steer[lane] = sine_cosine(m.steer[lane])
        m.sin_turn[lane], m.cos_turn[lane] = sine_cosine(m.steer_step[lane])

    for step in range(1, n + 1):
        before = path[v, step - 1]
        now = path[v, step]
        for lane in range(lanes):
            cos_steer = m.cos_steer[lane] * m.cos_turn[lane] - m.sin_steer[lane] * m.sin_turn[lane]
            sin_steer = m.sin_steer[lane] * m.cos_turn[lane] + m.cos_steer[lane] * m.sin_turn[lane]
            m.cos_steer[lane] = cos_steer
            m.sin_steer[lane] = sin_steer
        if clipped:
            clip_steer(m, lanes, step)
        for lane in range(lanes):
            cos_before = m.cos_before[lane]
            sin_before = m.sin_before[lane]
            cos_steer = m.cos_steer[lane]
            speed = m.speed[lane]
            drag = m.drag[lane] * m.drag_change[lane]
            push = m.throttle[lane] + step * m.throttle_step[lane] if speed <= TOP_SPEED else 0.0

            # tan(slip) = ratio * tan(steer), cos(slip) >= 0 because atan lies in [-pi/2, pi/2].
            across = SLIP_RATIO * m.sin_steer[lane]
            norm = 1.0 / math.sqrt(across * across + cos_steer * cos_steer)
            cos_slip = abs(cos_steer) * norm
            sin_slip = across * norm if cos_steer >= 0.0 else -across * norm

            move = dt * speed
            dx = -move * (sin_before * cos_slip - cos_before * sin_slip)
            dy = move * (cos_before * cos_slip + sin_before * sin_slip)
            yaw = (m.yaw_step[lane] + yaw_gain * speed * sin_slip) * yaw_friction
            heading = m.heading[lane] + yaw
            sin_heading, cos_heading = sine_cosine(heading)
            vx = dx * rate
            vy = dy * rate
            ax = (vx - m.vx[lane]) * rate
            ay = (vy - m.vy[lane]) * rate

            now.x[lane] = before.x[lane] + dx
            now.y[lane] = before.y[lane] + dy
            now.cos[lane] = cos_heading
            now.sin[lane] = sin_heading
            now.moved[lane] = before.moved[lane] + abs(move)
            m.cos_before[lane] = before.cos[lane]
            m.sin_before[lane] = before.sin[lane]
            m.heading[lane] = heading
            m.yaw_step[lane] = yaw
            m.speed[lane] = (speed + dt * push) * drag
            m.drag[lane] = drag
            m.jerk_x[lane] = (ax - m.ax[lane]) * rate
            m.jerk_y[lane] = (ay - m.ay[lane]) * rate
            m.vx[lane] = vx
            m.vy[lane] = vy
            m.ax[lane] = ax
            m.ay[lane] = ay

    for lane in range(lanes):
        if worlds[first + lane, v].end == RUNNING:
            store(worlds[first + lane, v], lane, m, path[v, n])
