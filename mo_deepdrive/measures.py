"""The objectives that are measured by a function of their own, after the kernel's step."""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np

from mo_deepdrive.importing import import_named
from mo_deepdrive.objectives import INDEX, OBJECTIVES
from mo_deepdrive.params import chosen_objectives, make_params, reward_signs, vehicle_record

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from mo_deepdrive.config import EnvConfig
    from mo_deepdrive.simulation.state import Records

REASON_LENGTH = 300  # of a message of Numba, which may have hundreds of lines


class Measure(NamedTuple):
    """What fills a column of the rewards, which column, and by what the magnitude is multiplied there.

    ``write(worlds, params, acting, column, sign, rewards)`` is compiled.
    """

    write: Callable[[Records, Records, NDArray[np.bool_], int, float, NDArray[np.float32]], None]
    column: int
    sign: float


@functools.cache
def _writer(function: Callable[[Any, int, Any], float]) -> Any:
    """What writes one column of the rewards by ``function``, the ``measure`` of an objective.

    It is not in the disk cache, whose files would not notice a change of the function. The function is a constant of
    it, because Numba takes 10 microseconds to look at one that is an argument.
    """
    compiled = numba.njit(nogil=True, error_model="numpy")(function) if inspect.isfunction(function) else function

    def write(
        worlds: Records,
        params: Records,
        acting: NDArray[np.bool_],
        column: int,
        sign: float,
        rewards: NDArray[np.float32],
    ) -> None:
        """Write one column of the rewards.

        Args:
            worlds: (worlds, vehicles) of VEHICLE, after the step.
            params: (1,) of PARAMS.
            acting: (worlds, vehicles) whether the vehicle was on the road before the step; the reward is zero if not.
            column: which column.
            sign: by what the magnitude is multiplied.
            rewards: (worlds, vehicles, objectives) float32, written.
        """
        for i in range(worlds.shape[0]):
            for v in range(worlds.shape[1]):
                # Adding zero turns a cost of -0.0 into 0.0.
                rewards[i, v, column] = sign * compiled(worlds[i], v, params[0]) + 0.0 if acting[i, v] else 0.0

    return numba.njit(nogil=True, error_model="numpy")(write)


def make_measures(config: EnvConfig) -> tuple[Measure, ...]:
    """The objectives of a configuration that the kernel does not measure.

    Raises:
        ValueError: naming the objective, if its function cannot be compiled.
    """
    nothing = np.zeros((0, config.row.vehicles), dtype=vehicle_record(config))
    measures = []
    for column, (name, sign) in enumerate(zip(chosen_objectives(config), reward_signs(config), strict=True)):
        function = OBJECTIVES[INDEX[name]].measure
        if function is None:
            continue
        if isinstance(function, str):
            function = import_named(f"objective {name!r}: measure", function)
        measure = Measure(_writer(function), column, float(sign))
        flags, rewards = np.zeros(nothing.shape, dtype=np.bool_), np.zeros((*nothing.shape, 1), dtype=np.float32)
        try:
            measure.write(nothing, make_params(config), flags, column, measure.sign, rewards)
        except Exception as error:  # Numba raises KeyError for a field that does not exist
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:REASON_LENGTH]
            raise ValueError(f"objective {name!r}: its measure cannot be compiled: {reason}") from None
        measures.append(measure)
    return tuple(measures)
