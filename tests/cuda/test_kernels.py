"""The kernels compile for a GPU of compute capability 9.0, on a machine that may have none.

This finds what the compiler of the device refuses; ``make test-gpu`` finds wrong results.
"""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest
from numba import cuda
from numba.cuda import dispatcher

from mo_deepdrive import Objective, register_objective
from mo_deepdrive.device import cuda as device
from mo_deepdrive.device import worlds
from mo_deepdrive.world.config import EnvConfig
from mo_deepdrive.world.scenarios import SCENARIOS

CAPABILITY = (9, 0)
MOST_LOCAL = 8192  # bytes of a thread; the driver reserves it for all threads that a GPU can have at a time


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the kernels of the worlds that the test makes are compiled to."""
    found: list[str] = []

    def compile_kernel(kernel: Any, buffers: Any, argument: Any) -> None:
        types = numba.typeof(buffers), numba.typeof(argument)
        found.append(cuda.compile(kernel.py_func, types, device=False, cc=CAPABILITY, abi="numba")[0])

    # Worlds on the CPU hand the same buffers to the compiler of the GPU.
    monkeypatch.setattr(dispatcher, "get_current_device", lambda: SimpleNamespace(compute_capability=CAPABILITY))
    monkeypatch.setattr(device, "compile_kernel", compile_kernel)
    monkeypatch.setattr(worlds, "host_launcher", lambda form, buffers, mode, _: device.compiled(form, buffers, mode))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_kernels_of_every_scenario_compile(
    scenario: str, action_type: str, compiled: list[str], registries: None
) -> None:
    register_objective(Objective("slip", "m/s", -1, 10.0, "speed to the side", 100.0, measure=slip))
    objectives = (*SCENARIOS[scenario].objectives, "time", "slip")
    if SCENARIOS[scenario].others:
        objectives += ("near_miss",)
    delay = 2 if action_type == "continuous" else 0
    objectives = tuple(dict.fromkeys(objectives))
    config = EnvConfig(scenario=scenario, action_type=action_type, objectives=objectives, action_delay=delay)
    worlds.TensorWorlds(config, 2, "cpu")
    assert len(compiled) == 2  # a step and a restart
    for code in compiled:
        assert ".target sm_90" in code
        assert all(int(size) <= MOST_LOCAL for size in re.findall(r"__local_depot\d+\[(\d+)\]", code))


def slip(vehicles: Any, v: int, params: Any) -> float:
    vehicle = vehicles[v]
    return abs(vehicle.vx * vehicle.cos_heading + vehicle.vy * vehicle.sin_heading)


def on_a_cpu_alone(vehicles: Any, v: int, params: Any) -> float:
    return float(np.sort(vehicles[v].along)[0])


@pytest.mark.slow
def test_an_objective_that_does_not_compile_for_a_gpu_is_named(compiled: list[str], registries: None) -> None:
    register_objective(Objective("sorted", "m", 1, 10.0, "the shortest leg", 100.0, measure=on_a_cpu_alone))
    config = EnvConfig(scenario="one_waypoint", objectives=("time", "distance", "sorted"))
    with pytest.raises(ValueError, match=r"^objective 'sorted': its measure cannot be compiled for a GPU: "):
        worlds.TensorWorlds(config, 2, "cpu")
