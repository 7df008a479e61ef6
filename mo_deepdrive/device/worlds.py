"""A batch of worlds that takes and gives torch tensors, on a GPU or on the CPU."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from mo_deepdrive.batch import WorldBatch
from mo_deepdrive.device.kernels import NO_FAULT, RESET_NEEDED, WRONG_ACTION, Buffers, Form, Launcher, host_launcher
from mo_deepdrive.extras import needed_for
from mo_deepdrive.limits import check_state
from mo_deepdrive.machine import GIB, check_device, check_memory
from mo_deepdrive.objectives import INDEX, OBJECTIVES
from mo_deepdrive.observation import layout
from mo_deepdrive.params import vehicle_record
from mo_deepdrive.simulation.autoreset import DISABLED, NEXT_STEP, SAME_STEP
from mo_deepdrive.simulation.philox import STREAM
from mo_deepdrive.simulation.state import PARAMS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.config import EnvConfig

_MODES = {
    AutoresetMode.NEXT_STEP: NEXT_STEP,
    AutoresetMode.SAME_STEP: SAME_STEP,
    AutoresetMode.DISABLED: DISABLED,
}
_ALIGNMENT = 16  # bytes


class Outputs(NamedTuple):
    """What a decision writes.

    Attributes:
        observations: (N, V, size) float32 for the next decision.
        final_observations: (N, V, size) after this one, which differ where an episode was over and the next one has begun
            in the same step; ``observations`` themselves in other autoreset modes.
        rewards: (N, V, d) float32; zero for vehicles that had ended before.
        acted: (N, V) bool, which vehicles were on the road before the decision.
        terminated: (N, V) bool, after it, before a reset in the same step.
        truncated: (N, V) bool, likewise.
        over: (N,) bool, where no vehicle was on the road after it.
        ends: (N, V) int8, why vehicles have ended: positions in :data:`mo_deepdrive.simulation.state.ENDS`.
    """

    observations: torch.Tensor
    final_observations: torch.Tensor
    rewards: torch.Tensor
    acted: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    over: torch.Tensor
    ends: torch.Tensor


class TensorWorlds:
    """``count`` independent copies of one scenario on a device, moved together by one launch per decision.

    An episode is a function of a seed, the number of an environment and the number of the episode, whatever else is in
    the batch. :meth:`step` neither checks its argument nor waits for the device, and can be captured in a CUDA graph;
    what went wrong is found by :meth:`check`. Tensors are the same ones after every call, with other contents.

    Args:
        config: the environment's configuration.
        count: N.
        device: "cpu", "cuda" or one of several, as "cuda:1".
        autoreset: what happens to worlds whose episode is over.

    Attributes:
        device: where the tensors are.
        vehicles: V.
        objectives: names of the d objectives.
        continuous: whether actions are continuous.
        choices: how many discrete actions there are.
        outputs: all that a decision writes, also attributes by their own names: see :class:`Outputs`.
        fault: (1,) int64, not zero if something went wrong.

    Raises:
        ValueError: if the device does not exist, has too little memory or cannot compile an objective.
        ImportError: if the device needs numba-cuda, and it is not installed.
    """

    def __init__(
        self,
        config: EnvConfig,
        count: int,
        device: str | torch.device,
        autoreset: AutoresetMode = AutoresetMode.SAME_STEP,
    ):
        check_device("device", str(device))
        host = WorldBatch(config, 1)  # for what follows from the configuration
        self.config = config
        self.count = count
        self.device = torch.device(device)
        if self.device == torch.device("cuda"):
            self.device = torch.device("cuda", torch.cuda.current_device())
        self.scenario = host.scenario
        self.vehicles = self.scenario.vehicles
        self.objectives = host.objectives
        self.continuous = host.continuous
        self.choices = len(host.table)
        self._waypoints = host.params["n_waypoints"][0, : self.vehicles]
        self._record = vehicle_record(config)
        self._mode = _MODES[autoreset]
        self._shapes = self._output_shapes()
        self._check_memory()
        # One block holds all outputs, so that one copy keeps them.
        self._block = self._zeros(torch.uint8, sum(_bytes(*each) for each in self._shapes.values()))
        self.outputs = self._views(self._block)
        self.observations, self.final_observations, self.rewards, self.acted = self.outputs[:4]
        self.terminated, self.truncated, self.over, self.ends = self.outputs[4:]
        self.fault = self._zeros(torch.int64, 1)
        self._state = self._zeros(torch.uint8, count, self.vehicles, self._record.itemsize)
        self._streams = self._zeros(torch.uint8, count, STREAM.itemsize)
        self._waiting = self._zeros(torch.bool, count)
        self._mask = self._zeros(torch.bool, count)
        axes = (3,) if self.continuous else ()
        self._actions = self._zeros(torch.float32 if self.continuous else torch.int64, count, self.vehicles, *axes)
        self._launcher = self._make_launcher(host)

    def _output_shapes(self) -> dict[str, tuple[torch.dtype, tuple[int, ...]]]:
        """The type and the shape of every output that has memory of its own."""
        pairs = self.count, self.vehicles
        seen = (torch.float32, (*pairs, len(layout(self.scenario))))
        shapes = {
            "observations": seen,
            "final_observations": seen,
            "rewards": (torch.float32, (*pairs, len(self.objectives))),
            "acted": (torch.bool, pairs),
            "terminated": (torch.bool, pairs),
            "truncated": (torch.bool, pairs),
            "over": (torch.bool, (self.count,)),
            "ends": (torch.int8, pairs),
        }
        if self._mode != SAME_STEP:
            del shapes["final_observations"]
        return shapes

    def _check_memory(self) -> None:
        """Refuse more worlds than fit; outputs are counted twice, as whoever steps keeps a copy."""
        outputs = sum(_bytes(*each) for each in self._shapes.values())
        each = self._record.itemsize + 8 * (3 + 3 + 3) + 2  # with streams and scratch
        needed = 2 * outputs + self.count * self.vehicles * each
        what = f"num_envs = {self.count}"
        if self.device.type == "cpu":
            check_memory(what, needed)
            return
        free = torch.cuda.mem_get_info(self.device)[0] + torch.cuda.memory_reserved(self.device)
        free -= torch.cuda.memory_allocated(self.device)
        if needed > free:
            raise ValueError(
                f"{what} takes at least {needed / GIB:,.1f} GiB of the memory of {self.device}; "
                f"{free / GIB:,.1f} GiB are available"
            )

    def _zeros(self, dtype: torch.dtype, *shape: int) -> torch.Tensor:
        return torch.zeros(shape, dtype=dtype, device=self.device)

    def _views(self, block: torch.Tensor) -> Outputs:
        views, start = {}, 0
        for name, (dtype, shape) in self._shapes.items():
            views[name] = block[start : start + math.prod(shape) * dtype.itemsize].view(dtype).view(shape)
            start += _bytes(dtype, shape)
        return Outputs(**{"final_observations": views["observations"], **views})

    def _make_launcher(self, host: WorldBatch) -> Launcher:
        """What moves the worlds, with all that it reads and writes."""
        form = Form(
            self.vehicles,
            self.scenario.obstacles,
            self.scenario.cars,
            self.scenario.draws,
            self.config.physics_steps,
            host.measures,
            tuple(name for name in self.objectives if OBJECTIVES[INDEX[name]].measure is not None),
        )
        make_launcher: Any = host_launcher
        array: Any = torch.Tensor.numpy
        if self.device.type == "cuda":
            with needed_for(f"device = {str(self.device)!r}", "cuda"):
                from mo_deepdrive.device.cuda import array, make_launcher  # type: ignore[no-redef]

        pairs = self.count, self.vehicles
        self._waiting.fill_(True)
        table = host.table if self.choices else np.zeros((1, 4))  # no array of a GPU may be empty
        tensors = (
            self._state.view(-1),
            self._streams.view(-1),
            self._waiting,
            self._zeros(torch.int64, self.count),
            self._zeros(torch.int64, self.count),
            self._mask,
            self._actions,
            torch.from_numpy(table).to(self.device),
            *(torch.from_numpy(each.view(np.uint8)).to(self.device) for each in (host.params, host.no_pins)),
            self._zeros(torch.float64, *pairs, 3),
            self._zeros(torch.bool, *pairs),
            self._zeros(torch.bool, *pairs),
            *self.outputs,
            self.fault,
        )
        buffers = Buffers(*map(array, tensors))
        buffers = buffers._replace(
            worlds=buffers.worlds.view(self._record).reshape(pairs),
            streams=buffers.streams.view(STREAM),
            params=buffers.params.view(PARAMS),
            pins=buffers.pins.view(host.no_pins.dtype),
        )
        self._kept = tensors, host  # what the buffers are views of
        return make_launcher(form, buffers, self._mode, self.device)  # type: ignore[no-any-return]

    def begin(
        self, seeds: NDArray[Any], environments: NDArray[Any], mask: NDArray[np.bool_] | torch.Tensor | None = None
    ) -> None:
        """Start the first episodes (number 0) of streams of random numbers.

        Args:
            seeds: (N,) integers in [0, 2**64).
            environments: (N,) likewise below 2**32: the number of the environment among those with its seed.
            mask: (N,) in which worlds; in all if None.
        """
        streams = np.zeros(self.count, dtype=STREAM)
        streams["seed"], streams["environment"] = seeds, environments
        self._write(self._streams, streams, mask)
        self.next_episodes(mask)

    def next_episodes(self, mask: NDArray[np.bool_] | torch.Tensor | None = None) -> None:
        """Start the next episode of every world in ``mask`` (N,), or of all."""
        self._set_mask(mask)
        self._launcher.restart(True)

    def step(self, actions: torch.Tensor) -> None:
        """Move every running vehicle by one decision, and reset worlds as the autoreset mode says.

        An action that is not allowed is replaced, with those of the other vehicles of its world, by zeros, and
        :meth:`check` will say so.

        Args:
            actions: (N, V) int64 in [0, choices), or (N, V, 3) float32 in [-1, 1] (clipped), on the device.
        """
        self._actions.copy_(actions)
        self._launcher.step()

    def snapshot(self) -> Outputs:
        """The outputs in tensors of their own, which no later call changes."""
        return self._views(self._block.clone())

    def check(self, fault: int | None = None) -> None:
        """Raise an error if something went wrong since the last check; this waits for the device.

        Args:
            fault: the value of ``fault``, if it is known.

        Raises:
            ValueError: for an action that was not allowed, or if no valid scenario was found.
            ResetNeeded: if a world whose episode was over has been stepped, and its mode does not reset it.
        """
        fault = int(self.fault.item()) if fault is None else fault
        if fault == NO_FAULT:
            return
        self.fault.zero_()
        world, kind = divmod(fault, 4)
        if kind == WRONG_ACTION:
            allowed = "finite numbers" if self.continuous else f"integers in [0, {self.choices})"
            raise ValueError(
                f"an action of world {world} in an earlier step() was not allowed; expected {allowed}. Zeros were taken "
                "instead; check_actions=True finds such actions before the step"
            )
        if kind == RESET_NEEDED:
            raise ResetNeeded(
                f"step() on worlds whose episode is over or has not begun (one of them: {world}); reset them first"
            )
        raise WorldBatch(self.config, 1).no_scenario()

    def read_state(self) -> NDArray[Any]:
        """A copy of the states (N, V) of VEHICLE; this waits for the device."""
        return self._state.cpu().numpy().reshape(-1).view(self._record).reshape(self.count, self.vehicles).copy()

    def read_streams(self) -> NDArray[Any]:
        """A copy of the streams (N,) of STREAM; this waits for the device."""
        return self._streams.cpu().numpy().reshape(-1).view(STREAM).copy()

    def write(self, state: NDArray[Any], streams: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> None:
        """Overwrite states (N, V) and streams (N,), and compute observations and flags from them.

        Args:
            state: of VEHICLE.
            streams: of STREAM.
            mask: (N,) in which worlds; in all if None.

        Raises:
            ValueError: for values that the dynamics cannot reach; nothing changes.
        """
        check_state(state, self.config, self._waypoints)
        self._write(self._state, state, mask)
        self._write(self._streams, streams, mask)
        self._set_mask(mask)
        self._launcher.restart(False)

    def _write(self, tensor: torch.Tensor, records: NDArray[Any], mask: Any) -> None:
        given = torch.from_numpy(records.view(np.uint8).reshape(tensor.shape)).to(self.device)
        if mask is None:
            tensor.copy_(given)
        else:
            rows = torch.as_tensor(mask, device=self.device)
            tensor[rows] = given[rows]

    def _set_mask(self, mask: NDArray[np.bool_] | torch.Tensor | None) -> None:
        if mask is None:
            self._mask.fill_(True)
        else:
            self._mask.copy_(torch.as_tensor(mask))


def _bytes(dtype: torch.dtype, shape: tuple[int, ...]) -> int:
    """The memory of an output, up to where the next one may begin."""
    return -(-math.prod(shape) * dtype.itemsize // _ALIGNMENT) * _ALIGNMENT
