"""Reset options, which set parts of a scenario that would be drawn otherwise."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.names import nearest
from mo_deepdrive.scenarios import FARTHEST, Scenario
from mo_deepdrive.simulation.placing import pin_nothing
from mo_deepdrive.simulation.state import SPAWN, with_obstacles

if TYPE_CHECKING:
    from collections.abc import Mapping

MOST_TURNED = 250.0  # rad; largest heading


def option_names(scenario: Scenario) -> tuple[str, ...]:
    """The names of the reset options of a scenario."""
    if scenario.vehicles > 1:
        return ("starts",)
    obstacles = ("obstacle",) if scenario.obstacles == 1 else ("obstacles",) if scenario.obstacles else ()
    return ("start", "destination", *obstacles)


def _numbers(name: str, value: Any, shape: tuple[int, ...], form: str) -> np.ndarray:
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.array([])
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(f"reset option {name!r} = {value!r} must be {form}: finite numbers in m and rad")
    if (np.abs(numbers[..., :2]) > FARTHEST).any():
        raise ValueError(f"reset option {name!r} = {value!r} must have coordinates in [-{FARTHEST:g}, {FARTHEST:g}] m")
    if (np.abs(numbers[..., 2:]) > MOST_TURNED).any():
        turned = f"[-{MOST_TURNED:g}, {MOST_TURNED:g}] rad"
        raise ValueError(f"reset option {name!r} = {value!r} must have headings in {turned}")
    return numbers


def make_pins(options: Mapping[str, Any] | None, scenario: Scenario) -> np.ndarray | None:
    """The reset options as an array (1,) of SPAWN, with NaN for what is drawn; None for no options.

    Raises:
        ValueError: for unknown options, wrong shapes, or numbers that are not finite.
    """
    if not options:
        return None
    known = option_names(scenario)
    for name in options:
        if name not in known:
            raise ValueError(f"unknown reset option {name!r} in {scenario.title}; {nearest(name, known)}")
    array = np.zeros(1, dtype=with_obstacles(SPAWN, scenario.obstacles))
    pin_nothing(array)
    pins = array[0]
    if "start" in options:
        pins.starts[0] = _numbers("start", options["start"], (3,), "(x, y, heading)")
    if "starts" in options:
        pins.starts[:] = _numbers("starts", options["starts"], (2, 3), "((x, y, heading), (x, y, heading))")
    if "destination" in options:
        last = len(scenario.routes[0].waypoints) - 1
        pins.waypoints[0, last] = _numbers("destination", options["destination"], (2,), "(x, y)")
    if "obstacle" in options:
        pins.obstacle[:] = _numbers("obstacle", options["obstacle"], (2, 2), "((x, y), (x, y))")
    if "obstacles" in options:
        shape, form = (scenario.obstacles, 2, 2), f"{scenario.obstacles} times ((x, y), (x, y))"
        pins.obstacle[:] = _numbers("obstacles", options["obstacles"], shape, form).reshape(-1, 2)
    return array
