"""The objectives that are measured by a function of their own, after the kernel's step."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from mo_deepdrive.importing import import_named
from mo_deepdrive.objectives import INDEX, OBJECTIVES
from mo_deepdrive.params import chosen_objectives, make_params, vehicle_record
from mo_deepdrive.simulation.kernel import batch_rewards

if TYPE_CHECKING:
    from mo_deepdrive.config import EnvConfig

REASON_LENGTH = 300  # of a message of Numba, which may have hundreds of lines

_compiled: dict[Any, Any] = {}  # by plain functions


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
            measures.append(_compile(name, measure, config))
    return tuple(measures)


def _compile(name: str, function: Any, config: EnvConfig) -> Any:
    """A measure that is not the package's; it is not in the disk cache, whose files would not notice a change of it."""
    if inspect.isfunction(function):
        function = _compiled.setdefault(function, numba.njit(nogil=True, error_model="numpy")(function))
    nothing = np.zeros((0, config.row.vehicles), dtype=vehicle_record(config))
    flags, rewards = np.zeros(nothing.shape, dtype=np.bool_), np.zeros((*nothing.shape, 1), dtype=np.float32)
    try:
        batch_rewards((function,))(nothing, make_params(config), flags, rewards)
    except Exception as error:  # Numba raises KeyError for a field that does not exist
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:REASON_LENGTH]
        raise ValueError(f"objective {name!r}: its measure cannot be compiled: {reason}") from None
    return function
