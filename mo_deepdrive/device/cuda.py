"""The launcher of a GPU; importing this module needs numba-cuda."""

from __future__ import annotations

import functools
import warnings
from typing import Any

import numba
import numba_cuda  # noqa: F401  # first, as numba.cuda is another module where it is not installed
import numpy as np
import torch
from numba import cuda, float64
from numba.cuda import libdevice
from numba.cuda.core.errors import NumbaPerformanceWarning
from numba.cuda.extending import overload

from mo_deepdrive.device.kernels import Buffers, Form, Launcher, Scratch, after_decision, before_decision, begin_episode
from mo_deepdrive.simulation import dynamics, observation, traffic
from mo_deepdrive.simulation.kernel import deciding
from mo_deepdrive.simulation.trigonometry import floor
from mo_deepdrive.world.measures import reason

THREADS = 64  # of a block: many small blocks, since a thread takes many registers
# With fewer registers than they want, more worlds of several bodies fit beside one another, which makes them 10 to 15%
# faster; worlds of one body would become slower.
REGISTERS = 96


@overload(floor, strict=False, inline="always")  # type: ignore[untyped-decorator]
def _floor(x: Any) -> Any:  # noqa: ARG001
    return lambda x: libdevice.floor(x)


def _one_lane(dtype: np.dtype[Any]) -> Any:
    """A scratch record with one lane, as a type of Numba."""
    return numba.from_dtype(np.dtype([(name, np.float64, (1,)) for name in dtype.names or ()], align=True))


@functools.cache
def kernels(form: Form) -> tuple[Any, Any]:
    """The kernels ``step(buffers, mode)`` and ``restart(buffers, place)``, not compiled yet."""
    decide = deciding(form.measures)
    motion, pose, sight, driver = map(_one_lane, (dynamics.MOTION, dynamics.POSE, observation.SIGHT, traffic.TRAFFIC))
    spawn = numba.from_dtype(form.spawn)
    bodies, rows = form.vehicles + form.cars, form.physics_steps + 1
    drivers, draws = max(form.cars, 1), form.draws  # no array may be empty
    options = {"max_registers": REGISTERS} if bodies > 1 else {}

    # Memory of a thread is that of the function that asks for it, so both kernels have these lines.
    @cuda.jit(**options)  # type: ignore[untyped-decorator]
    def step_kernel(b: Buffers, mode: int) -> None:
        i = cuda.grid(1)
        if i < b.worlds.shape[0]:
            s = Scratch(
                cuda.local.array(1, motion),
                cuda.local.array(drivers, driver),
                cuda.local.array((bodies, rows), pose),
                cuda.local.array(1, sight),
                cuda.local.array(1, spawn),
                cuda.local.array((1, draws), float64),
            )
            before_decision(b, i, mode)
            decide(
                b.worlds, i, i + 1, b.actions, b.table, b.params, b.controls, s.motion, s.cars, s.path, s.sight,
                b.final_observations, b.rewards, b.acted, b.ended, b.timed_out,
            )  # fmt: skip
            after_decision(b, s, i, mode)

    @cuda.jit(**options)  # type: ignore[untyped-decorator]
    def restart_kernel(b: Buffers, place: bool) -> None:
        i = cuda.grid(1)
        if i < b.worlds.shape[0] and b.mask[i]:
            s = Scratch(
                cuda.local.array(1, motion),
                cuda.local.array(drivers, driver),
                cuda.local.array((bodies, rows), pose),
                cuda.local.array(1, sight),
                cuda.local.array(1, spawn),
                cuda.local.array((1, draws), float64),
            )
            begin_episode(b, s, i, place)

    return step_kernel, restart_kernel


def array(tensor: torch.Tensor) -> Any:
    """A tensor as an array of numba-cuda, in the same memory."""
    return cuda.as_cuda_array(tensor)


def compiled(form: Form, buffers: Any, mode: int) -> tuple[Any, Any]:
    """Both kernels for these buffers.

    Raises:
        ValueError: naming the objective whose measure does not compile for the GPU.
    """
    step, restart = kernels(form)
    try:
        return compile_kernel(step, buffers, mode), compile_kernel(restart, buffers, True)
    except Exception:  # Numba raises errors of many kinds
        for name, measure in zip(form.measured, form.measures, strict=True):
            try:
                compile_kernel(kernels(form._replace(measures=(measure,), measured=(name,)))[0], buffers, mode)
            except Exception as error:
                problem = reason(error)
                raise ValueError(f"objective {name!r}: its measure cannot be compiled for a GPU: {problem}") from None
        raise


def compile_kernel(kernel: Any, buffers: Any, argument: int | bool) -> Any:
    """A kernel for these arguments, on the current GPU."""
    return kernel.specialize(buffers, argument)


def make_launcher(form: Form, buffers: Buffers, mode: int, device: torch.device) -> Launcher:
    """The launcher of a GPU, on PyTorch's current stream.

    Raises:
        ValueError: naming an objective whose measure does not compile for the GPU.
    """
    with cuda.gpus[device.index]:
        step, restart = compiled(form, buffers, mode)
    blocks = -(-buffers.worlds.shape[0] // THREADS)
    streams: dict[int, tuple[Any, Any]] = {}

    def launch(which: int, argument: int | bool) -> None:
        handle = torch.cuda.current_stream(device).cuda_stream
        with cuda.gpus[device.index]:
            if handle not in streams:
                stream = cuda.external_stream(handle) if handle else 0  # the default stream has no handle
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", NumbaPerformanceWarning)  # of few worlds
                    streams[handle] = step[blocks, THREADS, stream], restart[blocks, THREADS, stream]
            streams[handle][which](buffers, argument)

    graph: torch.cuda.CUDAGraph | None = None
    launched = False  # which loads the kernel, as a graph cannot

    def launch_step() -> None:
        """Launch a step as a graph: Numba takes longer to look at its arguments than the GPU to move the worlds."""
        nonlocal graph, launched
        if not launched or torch.cuda.is_current_stream_capturing():
            launched = True
            launch(0, mode)
            return
        if graph is None:
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.device(device), torch.cuda.graph(graph, capture_error_mode="thread_local"):
                launch(0, mode)
        graph.replay()

    return Launcher(launch_step, lambda place: launch(1, place))
