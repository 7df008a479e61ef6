"""The objectives that are measured by a function of their own, after the kernel's step."""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from mo_deepdrive.simulation.kernel import batch_rewards
from mo_deepdrive.support.importing import import_named
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES
from mo_deepdrive.world.params import chosen_objectives, make_params, vehicle_record

if TYPE_CHECKING:
    from mo_deepdrive.simulation.state import Record, Records
    from mo_deepdrive.world.config import EnvConfig

REASON_LENGTH = 300  # of a message of Numba, which may have hundreds of lines


@functools.cache
def _compiled(function: Any) -> Any:
    """A measure of a user, as the package's own ones are, with a world to itself.

    It is not in the disk cache, whose files would not notice a change of the function.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    compiled = numba.njit(**options)(function) if inspect.isfunction(function) else function

    @numba.njit(**options)  # type: ignore[untyped-decorator]
    def measure(worlds: Records, i: int, v: int, params: Record) -> float:
        magnitude: float = compiled(worlds[i], v, params)
        return magnitude

    return measure


def make_measures(config: EnvConfig) -> tuple[Any, ...]:
    """The compiled measures of a configuration, in the order of its objectives.

    Raises:
        ValueError: naming the objective, if its function cannot be compiled.
    """
    measures = []
    for name in chosen_objectives(config):
        measure = OBJECTIVES[INDEX[name]].measure
        if isinstance(measure, str):
            measures.append(import_named(f"objective {name!r}: measure", measure))
        elif measure is not None:
            measures.append(_checked(name, _compiled(measure), config))
    return tuple(measures)


def _checked(name: str, measure: Any, config: EnvConfig) -> Any:
    """The measure, if it can be compiled for the worlds of a configuration."""
    nothing = np.zeros((0, config.scenario_data.vehicles), dtype=vehicle_record(config))
    flags, rewards = np.zeros(nothing.shape, dtype=np.bool_), np.zeros((*nothing.shape, 1), dtype=np.float32)
    try:
        batch_rewards((measure,))(nothing, make_params(config), flags, rewards)
    except Exception as error:  # Numba raises KeyError for a field that does not exist
        raise ValueError(f"objective {name!r}: its measure cannot be compiled: {reason(error)}") from None
    return measure


def reason(error: Exception) -> str:
    """An error of Numba in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:REASON_LENGTH]
