"""A batch of worlds that takes and gives torch tensors, on a GPU or on the CPU."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from mo_deepdrive.device.kernels import NO_FAULT, RESET_NEEDED, WRONG_ACTION, Buffers, Form, Launcher, host_launcher
from mo_deepdrive.simulation.autoreset import SAME_STEP
from mo_deepdrive.simulation.philox import STREAM
from mo_deepdrive.simulation.state import PARAMS
from mo_deepdrive.support.extras import needed_for
from mo_deepdrive.support.machine import GIB, check_device, check_memory
from mo_deepdrive.world.batch import MODES, Transition, WorldBatch
from mo_deepdrive.world.limits import check_state
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.params import vehicle_record

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.world.config import EnvConfig

_ALIGNMENT = 16  # bytes


class TensorWorlds:
    """``count`` independent copies of one scenario on a device, moved together by one launch per decision.

    An episode is a function of a seed, the number of an environment and the number of the episode, whatever else is in
    the batch. :meth:`step` neither checks its argument nor waits for the device, and can be captured in a CUDA graph;
    what went wrong is found by :meth:`check`. Tensors are the same ones after every call, with other contents.

    ``outputs`` are all that a decision writes, also attributes by the names in :class:`Transition`; ``waiting`` (N,) is
    True where an episode is over and its world has not been reset; ``fault`` (1,) is not zero if something went wrong.
    A ValueError if the device does not exist, has too little memory or cannot compile an objective; an ImportError if
    it needs numba-cuda, and that is not installed.
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
        self.allowed_actions = "finite numbers" if self.continuous else f"integers in [0, {self.choices})"
        self._waypoints = host.params["n_waypoints"][0, : self.vehicles]
        self._record = vehicle_record(config)
        self._mode = MODES[autoreset]
        self._shapes = self._output_shapes()
        self._check_memory()
        # One block holds all outputs, so that one copy keeps them.
        self._block = self._zeros(torch.uint8, sum(_bytes(*each) for each in self._shapes.values()))
        self._places, start = {}, 0
        for name, (dtype, shape) in self._shapes.items():
            strides = [math.prod(shape[k + 1 :]) for k in range(len(shape))]
            self._places[name] = (dtype, shape, strides, start // dtype.itemsize)
            start += _bytes(dtype, shape)
        self.outputs = self._views(self._block)
        self.observations, self.final_observations, self.rewards, self.acted = self.outputs[:4]
        self.terminated, self.truncated, self.over, self.ends = self.outputs[4:]
        self.fault = self._zeros(torch.int64, 1)
        blank = torch.from_numpy(host.state.view(np.uint8).reshape(1, self.vehicles, -1))
        self._state = blank.to(self.device).repeat(count, 1, 1)
        self._streams = self._zeros(torch.uint8, count, STREAM.itemsize)
        self.waiting = self._zeros(torch.bool, count)
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
            "final": seen,
            "rewards": (torch.float32, (*pairs, len(self.objectives))),
            "acted": (torch.bool, pairs),
            "terminated": (torch.bool, pairs),
            "truncated": (torch.bool, pairs),
            "over": (torch.bool, (self.count,)),
            "ends": (torch.int8, pairs),
        }
        if self._mode != SAME_STEP:
            del shapes["final"]
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

    def _views(self, block: torch.Tensor) -> Transition:
        typed = {dtype: block.view(dtype) for dtype in (torch.float32, torch.bool, torch.int8)}
        views = {
            name: typed[dtype].as_strided(shape, strides, start)
            for name, (dtype, shape, strides, start) in self._places.items()
        }
        views.setdefault("final", views["observations"])
        return Transition(**views)

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
                from mo_deepdrive.device.cuda import array, make_launcher

        pairs = self.count, self.vehicles
        self.waiting.fill_(True)
        table = host.table if self.choices else np.zeros((1, 4))  # no array of a GPU may be empty
        tensors = (
            self._state.view(-1),
            self._streams.view(-1),
            self.waiting,
            self._zeros(torch.int64, self.count),
            self._zeros(torch.int64, self.count),
            self._mask,
            self._actions,
            torch.from_numpy(table).to(self.device),
            *(torch.from_numpy(each.view(np.uint8)).to(self.device) for each in (host.params, host.no_pins)),
            self._zeros(torch.float64, *pairs, 3),
            self._zeros(torch.bool, *pairs),
            self._zeros(torch.bool, *pairs).fill_(True),  # as the state says
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

    def begin(self, seeds: NDArray[Any], environments: NDArray[Any]) -> None:
        """Start the first episodes (number 0) of new streams of random numbers.

        Seeds (N,) are below 2**64, ``environments`` (N,) below 2**32: which one among those with the same seed.
        """
        self.write_streams(make_streams(seeds, environments))
        self.next_episodes()

    def next_episodes(self, mask: torch.Tensor | None = None) -> None:
        """Start the next episode in every world of ``mask`` (N,) bool on the device, or in all."""
        self._mask.fill_(True) if mask is None else self._mask.copy_(mask)
        self._launcher.restart(True)

    def step(self, actions: torch.Tensor) -> None:
        """Move every running vehicle by one decision, and reset worlds as the autoreset mode says.

        The actions, on the device, are (N, V) int64 in [0, choices), or (N, V, 3) float32 in [-1, 1] (clipped). One
        that is not allowed is replaced, with those of the other vehicles of its world, by zeros, and :meth:`check` will
        say so.
        """
        self._actions.copy_(actions)
        self._launcher.step()

    def snapshot(self) -> Transition:
        """The outputs in tensors of their own, which no later call changes."""
        return self._views(self._block.clone())

    def check(self, fault: int | None = None) -> None:
        """Raise an error if something went wrong since the last check, of which ``fault`` is known or waited for.

        A ValueError for an action that was not allowed, or if no valid scenario was found; ResetNeeded if a world whose
        episode was over has been stepped, and its mode does not reset it.
        """
        fault = int(self.fault.item()) if fault is None else fault
        if fault == NO_FAULT:
            return
        self.fault.zero_()
        world, kind = divmod(fault, 4)
        if kind == WRONG_ACTION:
            raise ValueError(
                f"an action of world {world}, perhaps of an earlier step, is not allowed; expected "
                f"{self.allowed_actions}. Zeros were taken instead; check_actions=True refuses it before a world moves"
            )
        if kind == RESET_NEEDED:
            raise ResetNeeded(
                f"step() on worlds whose episode is over or has not begun (one of them: {world}); reset them first"
            )
        raise WorldBatch(self.config, 1).no_scenario()

    def read_states(self) -> NDArray[Any]:
        """A copy of the states (N, V) of VEHICLE; this waits for the device."""
        return _records(self._state, self._record).reshape(self.count, self.vehicles)

    def read_streams(self) -> NDArray[Any]:
        """A copy of the streams (N,) of STREAM; this waits for the device."""
        return _records(self._streams, STREAM)

    def write_states(self, states: NDArray[Any], rows: NDArray[np.int64] | None = None) -> None:
        """Overwrite states (k, V) of VEHICLE of the worlds ``rows`` (k,), or of all, with observations and flags.

        A ValueError for values that the dynamics cannot reach; nothing changes.
        """
        check_state(states, self.config, self._waypoints)
        self._mask.fill_(rows is None)
        if rows is not None:
            self._mask[torch.from_numpy(rows).to(self.device)] = True
        self._write(self._state, states, rows)
        self._launcher.restart(False)

    def write_streams(self, streams: NDArray[Any], rows: NDArray[np.int64] | None = None) -> None:
        """Overwrite the streams (k,) of STREAM of the worlds ``rows`` (k,), or of all."""
        self._write(self._streams, streams, rows)

    def _write(self, tensor: torch.Tensor, records: NDArray[Any], rows: NDArray[np.int64] | None) -> None:
        given = torch.from_numpy(records.view(np.uint8).reshape(len(records), *tensor.shape[1:])).to(self.device)
        if rows is None:
            tensor.copy_(given)
        else:
            tensor[torch.from_numpy(rows).to(self.device)] = given


def make_streams(seeds: NDArray[Any], environments: NDArray[Any]) -> NDArray[Any]:
    """Streams (N,) of STREAM at their first episode, of seeds (N,) and numbers of environments (N,)."""
    streams = np.zeros(len(seeds), dtype=STREAM)
    streams["seed"], streams["environment"] = seeds, environments
    return streams


def _records(tensor: torch.Tensor, dtype: np.dtype[Any]) -> NDArray[Any]:
    """A copy of a tensor of bytes as records."""
    return tensor.cpu().numpy().copy().reshape(-1).view(dtype)


def _bytes(dtype: torch.dtype, shape: tuple[int, ...]) -> int:
    """The memory of an output, up to where the next one may begin."""
    return -(-math.prod(shape) * dtype.itemsize // _ALIGNMENT) * _ALIGNMENT
