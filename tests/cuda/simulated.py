"""Run the kernels and their launcher in Numba's simulator of CUDA, and compare them with the launcher of the CPU.

    NUMBA_ENABLE_CUDASIM=1 NUMBA_DISABLE_JIT=1 python -m tests.cuda.simulated

prints "SCENARIO ACTION_TYPE: N episodes". The simulator runs Python, one thread of the device after another.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numba.cuda.simulator import kernelapi
from numba.cuda.simulator.cudadrv.devicearray import FakeCUDAArray
from numba.np import numpy_support

from mo_deepdrive.device import cuda as device
from mo_deepdrive.device import worlds
from mo_deepdrive.device.kernels import Buffers
from mo_deepdrive.world.config import EnvConfig
from mo_deepdrive.world.scenarios import SCENARIOS

COUNT = 66  # two blocks, the second of which is not full
DECISIONS = 4


def with_attributes(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """A record whose fields are attributes, as in compiled code."""
    if dtype.names is None:
        return dtype
    fields = [(name, with_attributes(dtype[name].base), dtype[name].shape) for name in dtype.names]
    return np.dtype((np.record, fields))


def local_array(_: Any, shape: Any, dtype: Any) -> np.ndarray:
    """What ``cuda.local.array`` gives a thread."""
    return np.empty(shape, with_attributes(numpy_support.as_dtype(dtype)))


def simulated(form: Any, buffers: Buffers, mode: int, _: Any) -> Any:
    """The launcher of a GPU for buffers of NumPy."""
    fakes = Buffers(*(FakeCUDAArray(np.asarray(each)) for each in buffers))
    return device.make_launcher(form, fakes, mode, SimpleNamespace(index=0))  # type: ignore[arg-type]


def main() -> None:
    kernelapi.FakeCUDALocal.array = local_array
    torch.cuda.current_stream = lambda _: SimpleNamespace(cuda_stream=0)  # type: ignore[assignment]
    torch.cuda.is_current_stream_capturing = lambda: True  # so that a step is launched as it is
    jit = device.cuda.jit
    device.cuda.jit = lambda **_: jit()  # the simulator knows no registers
    host_launcher = worlds.host_launcher
    for scenario in SCENARIOS:
        for action_type in ("discrete", "continuous"):
            config = EnvConfig(scenario=scenario, action_type=action_type, time_limit=0.3, action_delay=1)
            pair = []
            for launcher in (host_launcher, simulated):
                worlds.host_launcher = launcher
                pair.append(worlds.TensorWorlds(config, COUNT, "cpu", AutoresetMode.SAME_STEP))
            rng, episodes = np.random.default_rng(0), 0
            for each in pair:
                each.begin(np.full(COUNT, 3), np.arange(COUNT))
            for _ in range(DECISIONS):
                form = (COUNT, pair[0].vehicles)
                actions = rng.uniform(-1, 1, (*form, 3)) if pair[0].continuous else rng.integers(0, 22, form)
                actions = torch.from_numpy(actions.astype(np.float32 if pair[0].continuous else np.int64))
                for each in pair:
                    each.step(actions)
                    each.check()
                for ours, theirs in zip(pair[1].outputs, pair[0].outputs, strict=True):
                    torch.testing.assert_close(ours, theirs, rtol=0.0, atol=0.0)
                episodes += int(pair[0].over.sum())
            print(f"{scenario} {action_type}: {episodes} episodes")


if __name__ == "__main__":
    main()
