"""The compiled motion of a vehicle against a plain loop over the equations of the specification, section 3."""

from __future__ import annotations

import dataclasses
import math

import numba
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from mo_deepdrive.simulation.dynamics import drive, make_scratch
from mo_deepdrive.simulation.state import ENDS, LANES, VEHICLE
from mo_deepdrive.simulation.trigonometry import LARGEST, angle_of, sine_cosine
from mo_deepdrive.world.config import EnvConfig
from mo_deepdrive.world.params import make_params

Real = np.longdouble
needs_extended_precision = pytest.mark.skipif(
    np.finfo(np.longdouble).eps > 1e-18, reason="long double has no more digits than double here"
)

W = Real("2.300675555555556")
REAR = W / 8
CENTRE = W / 2 + Real("0.05") * W
L_B = CENTRE - REAR
L_A = (W - REAR) - CENTRE
PI = Real(math.pi)
G = Real("9.807")


@dataclasses.dataclass
class Car:
    """The state of a vehicle, by the names of the specification."""

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    speed: float = 0.0
    yaw_step: float = 0.0
    vx: float = 0.0
    vy: float = 0.0
    ax: float = 0.0
    ay: float = 0.0
    steer: float = 0.0
    throttle: float = 0.0
    brake: float = 0.0
    travelled: float = 0.0
    g_force: float = 0.0
    jerk: float = 0.0


FIELDS = tuple(field.name for field in dataclasses.fields(Car))


@dataclasses.dataclass(frozen=True)
class Rules:
    """The settings that change the motion."""

    simulation_frequency: int = 60
    physics_steps: int = 6
    constrain_controls: bool = False
    ignore_brake: bool = False

    @property
    def params(self) -> np.record:
        return make_params(
            EnvConfig(
                scenario="one_waypoint",
                simulation_frequency=self.simulation_frequency,
                decision_frequency=self.simulation_frequency // self.physics_steps,
                constrain_controls=self.constrain_controls,
                ignore_brake=self.ignore_brake,
            )
        )[0]


def controls_over_a_decision(car: Car, target: tuple[float, float, float], rules: Rules) -> list[tuple[Real, ...]]:
    """Steer, throttle and brake at each physics step of a decision (section 2)."""
    n = rules.physics_steps
    held = [Real(car.steer), Real(car.throttle), Real(car.brake)]
    steer, throttle, brake = (Real(value) for value in target)
    if rules.ignore_brake:
        brake = Real(0)
    changes = [steer - held[0], throttle - held[1], brake - held[2]]
    if rules.constrain_controls:
        for k, limit in ((0, 0.03 * n), (1, 0.04 * n)):
            changes[k] = min(max(changes[k], -Real(limit)), Real(limit))
    ramp = []
    for i in range(1, n + 1):
        now = [start + Real(i) / n * change for start, change in zip(held, changes, strict=True)]
        if brake == 0:
            now[2] = Real(0)
        ramp.append(tuple(now))
    return ramp


def literal_decision(car: Car, target: tuple[float, float, float], rules: Rules) -> Car:
    """One decision, equation by equation, in extended precision."""
    rate = Real(rules.simulation_frequency)
    dt = 1 / rate
    frictions = 60 / rate  # the exponents scale with dt * 60
    x, y, h, v, w = (Real(getattr(car, name)) for name in ("x", "y", "heading", "speed", "yaw_step"))
    velocity = np.array([Real(car.vx), Real(car.vy)])
    acceleration = np.array([Real(car.ax), Real(car.ay)])
    jerk = np.zeros(2, dtype=Real)
    travelled = Real(car.travelled)
    ramp = controls_over_a_decision(car, target, rules)
    for steer, throttle, brake in ramp:
        if v > 100:
            throttle = Real(0)
        slip = np.arctan(L_A / (L_A + L_B) * np.tan(min(max(steer, -PI), PI)))
        ahead = dt * v * np.cos(w + slip)
        side = dt * v * np.sin(w + slip)
        travelled += abs(dt * v)
        w = (w + dt * v / L_B * np.sin(slip)) * Real("0.95") ** frictions
        v = (v + dt * throttle) * Real("0.999") ** frictions * Real("0.96") ** (brake * frictions)
        before = np.array([x, y])
        # Here pi is exact, not rounded to double precision.
        quarter = np.arccos(Real(0))
        x = x + ahead * np.cos(h + quarter) + side * np.cos(h)
        y = y + ahead * np.sin(h + quarter) + side * np.sin(h)
        h = h + w
        new_velocity = (np.array([x, y]) - before) * rate
        new_acceleration = (new_velocity - velocity) * rate
        jerk = (new_acceleration - acceleration) * rate
        velocity, acceleration = new_velocity, new_acceleration
    steer, throttle, brake = ramp[-1]
    return Car(
        x, y, h, v, w, *velocity, *acceleration, steer, throttle, brake, travelled,
        g_force=np.hypot(*acceleration) / G, jerk=np.hypot(*jerk),
    )  # fmt: skip


def compiled_decisions(car: Car, targets: list[tuple[float, float, float]], rules: Rules) -> list[Car]:
    """The same decisions, by the package."""
    state = np.zeros((1, 1), dtype=VEHICLE)
    vehicle = state[0, 0]
    for name in FIELDS:
        vehicle[name] = getattr(car, name)
    vehicle.cos_heading, vehicle.sin_heading = math.cos(car.heading), math.sin(car.heading)
    # The heading one physics step ago.
    vehicle.cos_before, vehicle.sin_before = math.cos(car.heading - car.yaw_step), math.sin(car.heading - car.yaw_step)
    params = rules.params
    scratch = make_scratch(1, params.physics_steps)
    cars = []
    for target in targets:
        controls = np.array([[target]], dtype=np.float64)
        drive(state, 0, 1, 0, controls, params, *scratch)
        cars.append(Car(**{name: float(vehicle[name]) for name in FIELDS}))
    return cars


def assert_same(ours: Car, literal: Car, rules: Rules, steps: int, spun: float, fast: float) -> None:
    """Equal up to 1e-12 relatively, or up to the rounding errors of small numbers.

    The rounding error of an angle is proportional to its size, so it grows with the total rotation (``spun``, rad). The
    direction of the velocity is as accurate as the angle, and every difference multiplies its error by the rate.
    """
    rate = rules.simulation_frequency
    digits = 1e-15 * (10 + steps)
    angle = digits * (1.0 + spun)
    place = digits * (1.0 + abs(float(literal.x)) + abs(float(literal.y))) + steps / rate * fast * angle
    floors = dict.fromkeys(FIELDS, digits) | {
        "x": place,
        "y": place,
        "heading": angle,
        "vx": fast * angle,
        "vy": fast * angle,
        "ax": fast * angle * rate,
        "ay": fast * angle * rate,
        "g_force": fast * angle * rate,
        "jerk": fast * angle * rate**2,
    }
    for name in FIELDS:
        expected = float(getattr(literal, name))
        assert getattr(ours, name) == pytest.approx(expected, rel=1e-12, abs=floors[name]), name


def well_posed(car: Car, target: tuple[float, float, float], rules: Rules) -> bool:
    """False if rounding decides: the tangent jumps at 90 degrees of steer, the throttle is cut off at 100 m/s."""
    ramp = controls_over_a_decision(car, target, rules)
    return abs(float(car.speed) - 100) > 1e-9 and all(abs(abs(steer) - PI / 2) > 1e-9 for steer, _, _ in ramp)


def check(car: Car, targets: list[tuple[float, float, float]], rules: Rules) -> list[Car]:
    """Compare the package's decisions with the plain ones where they are well posed; returns the package's."""
    assert well_posed(car, targets[0], rules)
    compiled = compiled_decisions(car, targets, rules)
    literal = car
    spun, fast = abs(car.heading), 1.0 + abs(car.speed)
    for count, (target, ours) in enumerate(zip(targets, compiled, strict=True), start=1):
        if not well_posed(literal, target, rules):
            break
        before, literal = literal, literal_decision(literal, target, rules)
        spun += rules.physics_steps * max(abs(float(literal.yaw_step)), abs(float(before.yaw_step)))
        fast = max(fast, 1.0 + abs(float(literal.speed)))
        assert_same(ours, literal, rules, count * rules.physics_steps, spun, fast)
    return compiled


def reals(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


cars = st.builds(
    Car,
    x=reals(-250, 250),
    y=reals(-250, 250),
    heading=reals(-20, 20),
    speed=reals(-60, 110),
    yaw_step=reals(-0.3, 0.3),
    vx=reals(-100, 100),
    vy=reals(-100, 100),
    ax=reals(-50, 50),
    ay=reals(-50, 50),
    steer=reals(-5, 5),
    throttle=reals(-10, 10),
    brake=reals(0, 4),
    travelled=reals(0, 1000),
)
all_targets = st.lists(
    st.tuples(reals(-5, 5), reals(-10, 10), st.one_of(st.just(0.0), reals(0, 4))), min_size=1, max_size=3
)
all_rules = st.builds(
    Rules,
    simulation_frequency=st.sampled_from([60, 60, 10, 20, 30, 120, 240]),
    physics_steps=st.sampled_from([1, 2, 5, 10]),
    constrain_controls=st.booleans(),
    ignore_brake=st.booleans(),
)


@pytest.mark.slow
@needs_extended_precision
@settings(max_examples=200)
@given(cars, all_targets, all_rules)
@example(Car(), [(0.1, 3.625, 0.0)] * 3, Rules())
@example(Car(speed=99.9, throttle=10.0), [(0.0, 10.0, 0.0)] * 3, Rules())
@example(Car(speed=5.0, brake=2.0), [(0.0, 0.0, 3.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)], Rules())
def test_a_decision_follows_the_equations_of_the_specification(
    car: Car, targets: list[tuple[float, float, float]], rules: Rules
) -> None:
    assume(well_posed(car, targets[0], rules))
    check(car, targets, rules)


@needs_extended_precision
@given(st.integers(0, 2**32 - 1))
def test_ordinary_driving_follows_the_equations_of_the_specification(seed: int) -> None:
    rng = np.random.default_rng(seed)
    targets = [(rng.uniform(-0.53, 0.53), rng.uniform(-3.7, 3.7), rng.choice([0.0, 1.0, 3.6])) for _ in range(20)]
    check(Car(heading=rng.uniform(-4, 4)), targets, Rules())


@needs_extended_precision
def test_the_throttle_has_no_effect_above_the_top_speed() -> None:
    above = check(Car(speed=101.0, throttle=3.0), [(0.0, 3.0, 0.0)], Rules())[0]
    coasting = check(Car(speed=101.0), [(0.0, 0.0, 0.0)], Rules())[0]
    below = check(Car(speed=99.0, throttle=3.0), [(0.0, 3.0, 0.0)], Rules())[0]
    assert above.speed == coasting.speed == pytest.approx(101.0 * 0.999**6, rel=1e-12)
    assert below.speed > 99.0 * 0.999**6 + 0.25
    assert above.throttle == 3.0
    at_top_speed = compiled_decisions(Car(speed=100.0, throttle=3.0), [(0.0, 3.0, 0.0)], Rules())[-1]
    pushed = 100.0
    for _ in range(6):
        pushed = (pushed + 3.0 / 60) * 0.999
    assert at_top_speed.speed == pytest.approx(pushed, rel=1e-12)


@needs_extended_precision
@pytest.mark.parametrize("frequency", [10, 20, 30, 60, 120, 240, 1000])
def test_frictions_are_those_of_a_second_at_every_simulation_frequency(frequency: int) -> None:
    rules = Rules(simulation_frequency=frequency, physics_steps=frequency)
    assert compiled_decisions(Car(speed=50.0), [(0.0, 0.0, 0.0)], rules)[0].speed == pytest.approx(50.0 * 0.999**60)
    braked = compiled_decisions(Car(speed=50.0, brake=1.0), [(0.0, 0.0, 1.0)], rules)[0]
    assert braked.speed == pytest.approx(50.0 * 0.999**60 * 0.96**60)
    # The heading change per physics step decays likewise; with straight steering, nothing else changes it.
    spun = compiled_decisions(Car(yaw_step=0.01), [(0.0, 0.0, 0.0)], rules)[0]
    assert spun.yaw_step == pytest.approx(0.01 * 0.95**60)


@numba.njit
def sines_and_cosines(angles, out):  # type: ignore[no-untyped-def]
    for k in range(len(angles)):
        out[k, 0], out[k, 1] = sine_cosine(angles[k])


def assert_accurate(angles: np.ndarray) -> None:
    out = np.zeros((len(angles), 2))
    sines_and_cosines(angles, out)
    exact = angles.astype(np.longdouble)
    assert np.abs(out[:, 0] - np.sin(exact)).max() < 4e-16
    assert np.abs(out[:, 1] - np.cos(exact)).max() < 4e-16


@needs_extended_precision
def test_sine_and_cosine_are_accurate_up_to_the_largest_angle() -> None:
    rng = np.random.default_rng(0)
    for largest in (10.0, 1e4, LARGEST):
        assert_accurate(rng.uniform(-largest, largest, 200_000))
    assert_accurate(np.linspace(-LARGEST, LARGEST, 100_001))
    sign = rng.choice([-1.0, 1.0], 100_000)
    assert_accurate(sign * 10 ** rng.uniform(-300.0, math.log10(LARGEST), 100_000))


@needs_extended_precision
def test_sine_and_cosine_are_accurate_next_to_multiples_of_an_eighth_turn() -> None:
    rng = np.random.default_rng(1)
    most = int(LARGEST / (math.pi / 4))
    angles = np.concatenate([np.arange(-1000, 1001), rng.integers(-most, most, 100_000)]) * (math.pi / 4)
    assert_accurate(angles)
    assert_accurate(np.nextafter(angles, np.inf))
    assert_accurate(np.nextafter(angles, -np.inf))
    assert_accurate(angles + rng.normal(0.0, 1e-6, len(angles)))


def test_sine_and_cosine_of_simple_angles_are_exact() -> None:
    assert sine_cosine(0.0) == (0.0, 1.0)
    for angle in (0.3, 1.0, 2.5, 3.7):
        sine, cosine = sine_cosine(angle)
        assert sine_cosine(-angle) == (-sine, cosine)


@numba.njit
def angles_of(y, x, out):  # type: ignore[no-untyped-def]
    for k in range(len(y)):
        out[k] = angle_of(y[k], x[k])


@needs_extended_precision
def test_the_angle_of_a_direction_is_accurate() -> None:
    rng = np.random.default_rng(3)
    turn = np.concatenate([rng.uniform(-math.pi, math.pi, 200_000), np.arange(-16, 17) * (math.pi / 16)])
    length = 10 ** rng.uniform(-6.0, 6.0, len(turn))
    y, x, out = length * np.sin(turn), length * np.cos(turn), np.zeros(len(turn))
    angles_of(y, x, out)
    exact = np.arctan2(y.astype(Real), x.astype(Real))
    assert (np.abs(out - exact) <= 4e-16 * np.abs(exact)).all()


def test_the_angle_of_a_simple_direction_is_that_of_atan2() -> None:
    for y in (0.0, -0.0, 1.0, -1.0):
        for x in (0.0, 1.0, -1.0):
            ours, expected = angle_of(y, x), math.atan2(y, x)
            assert (ours, math.copysign(1.0, ours)) == (expected, math.copysign(1.0, expected))


def make_worlds(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Worlds with a vehicle in any state, some with a steer to be clipped and some that have ended, and controls."""
    rng = np.random.default_rng(4)
    worlds = np.zeros((count, 1), dtype=VEHICLE)
    for name in FIELDS:
        worlds[name] = rng.normal(0.0, 2.0, (count, 1))
    worlds["steer"][::4] = 4.0
    worlds["brake"] = rng.choice([0.0, 1.0], (count, 1))
    worlds["end"] = rng.choice([0, ENDS.index("arrived")], (count, 1), p=[0.8, 0.2])
    for cos, sin in (("cos_heading", "sin_heading"), ("cos_before", "sin_before")):
        angle = rng.uniform(-4.0, 4.0, (count, 1))
        worlds[cos], worlds[sin] = np.cos(angle), np.sin(angle)
    controls = rng.normal(0.0, 2.0, (count, 1, 3))
    controls[:, :, 2] = rng.choice([0.0, 0.7], (count, 1))
    return worlds, controls


def test_worlds_that_move_side_by_side_move_as_if_they_were_alone() -> None:
    worlds, controls = make_worlds(LANES)
    params = Rules().params
    alone = worlds.copy()
    for first, last in ((0, 3), (3, LANES)):
        drive(worlds, first, last, 0, controls, params, *make_scratch(1, params.physics_steps))
    for i in range(LANES):
        drive(alone, i, i + 1, 0, controls, params, *make_scratch(1, params.physics_steps))
    assert worlds.tobytes() == alone.tobytes()
    before, _ = make_worlds(LANES)
    ended = worlds["end"] != 0
    assert ended.any()
    assert worlds[ended].tobytes() == before[ended].tobytes()
    assert (worlds["x"] != before["x"])[~ended].all()


def test_the_path_leads_from_the_pose_before_the_decision_to_that_after_it() -> None:
    params = make_params(EnvConfig(scenario="one_waypoint"))[0]
    worlds = np.zeros((1, 2), VEHICLE)
    vehicle = worlds[0, 1]
    vehicle.x, vehicle.y, vehicle.heading, vehicle.speed, vehicle.steer = 3.0, -2.0, 0.5, 8.0, 0.2
    vehicle.cos_heading = vehicle.cos_before = math.cos(0.5)
    vehicle.sin_heading = vehicle.sin_before = math.sin(0.5)
    motion, path = make_scratch(2, params.physics_steps)
    drive(worlds, 0, 1, 1, np.array([[[9.0, 9.0, 0.0], [0.2, 0.0, 0.0]]]), params, motion, path)
    rows = [[row[name][0] for name in ("x", "y", "cos", "sin")] for row in path[1]]
    assert rows[0] == [3.0, -2.0, math.cos(0.5), math.sin(0.5)]
    assert rows[-1] == [vehicle.x, vehicle.y, vehicle.cos_heading, vehicle.sin_heading]
    steps = np.linalg.norm(np.diff(np.array(rows)[:, :2], axis=0), axis=1)
    assert path["moved"][1, :, 0] == pytest.approx([0.0, *np.cumsum(steps)])
    assert vehicle.travelled == path["moved"][1, -1, 0]
    assert steps == pytest.approx(8.0 * params.dt * 0.999 ** np.arange(params.physics_steps))
    assert not path[0].view(np.uint8).any()
