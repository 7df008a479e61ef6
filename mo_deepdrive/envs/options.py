"""Reset options, which set parts of a scenario that would be drawn otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.simulation.placing import pin_nothing
from mo_deepdrive.simulation.road_traffic import ACCEPTED_GAPS
from mo_deepdrive.simulation.state import SPAWN, with_room
from mo_deepdrive.simulation.traffic import DESIRED_SPEEDS, HEADWAYS, YIELDINGS
from mo_deepdrive.support.names import nearest
from mo_deepdrive.support.plain_values import finite_numbers, whole_number
from mo_deepdrive.world.params import cars_in_traffic
from mo_deepdrive.world.routes import FARTHEST, MOST_TURNED

if TYPE_CHECKING:
    from mo_deepdrive.world.config import EnvConfig
    from mo_deepdrive.world.scenarios import Scenario

# The options with a number per oncoming car: the field of DRIVER, its range and unit.
DRIVERS: dict[str, tuple[str, tuple[float, float], str]] = {
    "desired_speeds": ("desired_speed", DESIRED_SPEEDS, "m/s"),
    "headways": ("headway", HEADWAYS, "s"),
    "yielding": ("yielding", YIELDINGS, "m/s^2"),
}
# The same on roads of segments.
ROAD_DRIVERS = {name: DRIVERS[name] for name in ("desired_speeds", "headways")}
ROAD_DRIVERS["accepted_gaps"] = ("accepted_gap", ACCEPTED_GAPS, "s")


def option_names(scenario: Scenario) -> tuple[str, ...]:
    """The names of the reset options of a scenario."""
    if scenario.roads:
        return ("routes", "distances", *(ROAD_DRIVERS if scenario.cars else ()))
    if scenario.vehicles > 1:
        return ("starts",)
    obstacles = ("obstacle",) if scenario.obstacles == 1 else ("obstacles",) if scenario.obstacles else ()
    cars = ("cars", *DRIVERS) if scenario.cars else ()
    return ("start", "destination", *obstacles, *cars)


def _numbers(name: str, value: Any, shape: tuple[int, ...], form: str) -> np.ndarray:
    numbers = finite_numbers(value)
    if numbers is None or numbers.shape != shape:
        raise ValueError(f"reset option {name!r} = {value!r} must be {form}: finite numbers in m and rad")
    if (np.abs(numbers[..., :2]) > FARTHEST).any():
        raise ValueError(f"reset option {name!r} = {value!r} must have coordinates in [-{FARTHEST:g}, {FARTHEST:g}] m")
    if (np.abs(numbers[..., 2:]) > MOST_TURNED).any():
        turned = f"[-{MOST_TURNED:g}, {MOST_TURNED:g}] rad"
        raise ValueError(f"reset option {name!r} = {value!r} must have headings in {turned}")
    return numbers


def _pin_drivers(pins: Any, options: Mapping[str, Any], cars: int, known: Mapping[str, Any]) -> None:
    """Set what is ``known`` of the drivers of the cars, the first car first."""
    for name, (field, (low, high), unit) in known.items():
        if name in options:
            value = options[name]
            shape = np.asarray(value, dtype=object).shape
            if len(shape) != 1 or not 1 <= shape[0] <= cars:
                raise ValueError(f"reset option {name!r} = {value!r} must have one number per car, at most {cars}")
            numbers = finite_numbers(value)
            if numbers is None or not ((numbers >= low) & (numbers <= high)).all():
                raise ValueError(f"reset option {name!r} = {value!r} must have numbers in [{low:g}, {high:g}] {unit}")
            pins.drivers[field][: len(numbers)] = numbers


def _pin_queues(pins: Any, options: Mapping[str, Any], scenario: Scenario) -> None:
    """Set routes, and distances along them, of the vehicles and then the cars; of fewer numbers the rest are drawn."""
    bodies = scenario.vehicles + scenario.cars
    most = max(route.segments[0].length for route in scenario.routes)
    for name, high, unit in (("routes", len(scenario.routes) - 1, ""), ("distances", most, " m")):
        if name in options:
            value = options[name]
            numbers = finite_numbers(value)
            fine = numbers is not None and numbers.ndim == 1 and 1 <= len(numbers) <= bodies
            if numbers is None or not fine or numbers.min() < 0 or numbers.max() > high:
                raise ValueError(
                    f"reset option {name!r} = {value!r} must have a number in [0, {high:g}]{unit} per vehicle and car, "
                    f"at most {bodies}"
                )
            if name == "routes" and (numbers % 1).any():
                raise ValueError(f"reset option 'routes' = {value!r} must have whole numbers")
            pins[name][: len(numbers)] = numbers


def checked_options(options: Any) -> dict[str, Any]:
    """The reset options as a dict, empty for None; a ValueError unless they are a mapping with names as keys."""
    if options is None:
        return {}
    if not isinstance(options, Mapping) or not all(isinstance(name, str) for name in options):
        raise ValueError(f"options = {options!r} must be a dict of reset options by name, or None")
    return dict(options)


def make_pins(options: Mapping[str, Any] | None, config: EnvConfig) -> np.ndarray | None:
    """The reset options as an array (1,) of SPAWN, with NaN for what is drawn; None for no options.

    A ValueError for unknown options, wrong shapes, or numbers that are not finite or out of range.
    """
    if not (options := checked_options(options)):
        return None
    scenario = config.scenario_data
    known = option_names(scenario)
    for name in options:
        if name not in known:
            raise ValueError(f"unknown reset option {name!r} in {scenario.title}; {nearest(name, known)}")
    array = np.zeros(1, dtype=with_room(SPAWN, scenario.obstacles, scenario.cars, 0))
    pin_nothing(array)
    pins = array[0]
    if "start" in options:
        pins.starts[0] = _numbers("start", options["start"], (3,), "(x, y, heading)")
    if "starts" in options:
        pins.starts[:2] = _numbers("starts", options["starts"], (2, 3), "((x, y, heading), (x, y, heading))")
    if "destination" in options:
        last = len(scenario.routes[0].waypoints) - 1
        pins.waypoints[0, last] = _numbers("destination", options["destination"], (2,), "(x, y)")
    if "obstacle" in options:
        pins.obstacle[:] = _numbers("obstacle", options["obstacle"], (2, 2), "((x, y), (x, y))")
    if "obstacles" in options:
        shape, form = (scenario.obstacles, 2, 2), f"{scenario.obstacles} times ((x, y), (x, y))"
        pins.obstacle[:] = _numbers("obstacles", options["obstacles"], shape, form).reshape(-1, 2)
    if scenario.roads:
        _pin_queues(pins, options, scenario)
        _pin_drivers(pins, options, scenario.cars, ROAD_DRIVERS)
    elif scenario.cars:
        allowed = f"a number of oncoming cars from 0 to {scenario.cars}"
        given = options.get("cars", cars_in_traffic(config))
        pins.n_cars = cars = whole_number("reset option 'cars'", given, 0, scenario.cars, allowed)
        _pin_drivers(pins, options, cars, DRIVERS)
    return array
