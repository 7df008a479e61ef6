"""One world as a WebAssembly module, from the functions that move it on a CPU, and what a page has to know about it.

Numba makes LLVM code of the kernel, llvmlite makes an object file of it, and ``wasm-ld`` a module of some 100 kB. All
arrays are in the module, with their first contents; the number in brackets is the type in JavaScript. It exports

    memory
    seed(n)       n a BigInt below 2**64: the stream of ``env.reset(seed=n)`` (PCG64, as NumPy seeds it); draws nothing
    restart()     begins the next episode of the stream: the first one after ``seed`` is that of ``env.reset(seed=n)``
    step()        one decision by ``actions``; leaves a world whose episode is over as it is
    keys(v, accelerate, brake, left, right)     the discrete action of vehicle v for keys (0 or 1) that are held down
    worlds, actions, observations, rewards, acted, ended, timed_out     addresses (WebAssembly.Global, use ``.value``)

and imports functions of ``Math`` by their names, all from ``env``: ``{env: {exp: Math.exp, ...}}`` with what
``WebAssembly.Module.imports`` lists. ``restart`` and ``step`` return 0, or 1 if there was no valid scenario, or an
action was not one of those that there are (then nothing has moved).

With V vehicles, d objectives and o observed entries, one after the other:

    worlds        (V) records, see ``state``
    actions       (V) int32, or (V, 3) float32 in [-1, 1] if they are continuous, those of ended vehicles, too
    observations  (V, o) float32, after ``restart`` and ``step``
    rewards       (V, d) float32 of the decision, all maximised; 0 for vehicles that had ended before
    acted         (V) uint8, whether a vehicle was on the road before the decision
    ended         (V) uint8, whether it has ended before the time limit
    timed_out     (V) uint8, whether it has ended by the time limit; all ended or timed out: the episode is over

A return is the sum of ``rewards`` in double precision. The JSON beside the module (:func:`describe`) has

    format                1
    id, arguments         of the environment
    title                 of the scenario
    scenario              its name
    vehicles, frequency   V, and decisions per second
    continuous            whether actions are
    actionNames           of the discrete actions, in order, or of the three axes
    maxDecisions          after which an episode is cut off
    objectives            [{key, unit, sign, scale}]: +1 for gains and -1 for costs, whose returns are negative;
                          ``scale`` is nominal, of a return
    observations          [{name, unit, scale}]
    ends                  reasons, by the code in ``state.fields.end``; "" while driving
    state                 {size, fields: {name: [offset, type, count]}}: of a vehicle, in bytes, types of NumPy such as
                          "f8", "i8", "b1"; count of numbers, such as 6 for the three waypoints (x, y)
    cars                  {offset, size, count, fields}, likewise: within the record of vehicle 0
    obstacles             {offset, count}: 4 doubles each, the two ends, within the record of vehicle 0

Lengths are metres, angles radians, counterclockwise, 0 along y: the direction of a vehicle is (-sin, cos) of its
``heading``; (x, y) is its centre. Its destination is the last of its first ``n_waypoints`` ``waypoints``, or on roads
of segments the end of its road, ``route``.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

from mo_deepdrive.device.kernels import allow
from mo_deepdrive.device.pcg64 import draw, seed_stream
from mo_deepdrive.simulation import observation, traffic
from mo_deepdrive.simulation.autoreset import DONE, resetting
from mo_deepdrive.simulation.dynamics import make_scratch
from mo_deepdrive.simulation.state import ENDS
from mo_deepdrive.world import actions as action_sets
from mo_deepdrive.world.batch import WorldBatch
from mo_deepdrive.world.measures import reason
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES
from mo_deepdrive.world.observation import layout

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from mo_deepdrive.world.config import EnvConfig

FORMAT = 1
TARGET = "wasm32-unknown-unknown"
LAYOUT = "e-m:e-p:32:32-p10:8:8-p20:8:8-i64:64-i128:128-n32:64-S128-ni:1:10:20"
ARRAYS = ("worlds", "actions", "observations", "rewards", "acted", "ended", "timed_out")
LINKERS = ("wasm-ld", *(f"wasm-ld-{version}" for version in range(21, 13, -1)))
LINK_OPTIONS = ("--no-entry", "--gc-sections", "--strip-all", "--stack-first", "-z", "stack-size=262144")
# What a browser has, by the names of C.
MATHS = ("exp", "sin", "cos", "atan2", "log", "pow", "tan", "acos", "asin", "atan")
# The low words of a product of 128 bits, which LLVM calls where WebAssembly has none: for checks of overflows.
PRODUCT = """
define hidden void @__multi3(ptr %to, i64 %a, i64 %a.high, i64 %b, i64 %b.high) noinline optnone {
  %a0 = and i64 %a, 4294967295
  %a1 = lshr i64 %a, 32
  %b0 = and i64 %b, 4294967295
  %b1 = lshr i64 %b, 32
  %low = mul i64 %a0, %b0
  %first = mul i64 %a0, %b1
  %second = mul i64 %a1, %b0
  %high = mul i64 %a1, %b1
  %low.carry = lshr i64 %low, 32
  %middle = add i64 %first, %low.carry
  %middle.low = and i64 %middle, 4294967295
  %sum = add i64 %second, %middle.low
  %middle.carry = lshr i64 %middle, 32
  %sum.carry = lshr i64 %sum, 32
  %high.1 = add i64 %high, %middle.carry
  %high.2 = add i64 %high.1, %sum.carry
  %cross.1 = mul i64 %a, %b.high
  %cross.2 = mul i64 %a.high, %b
  %high.3 = add i64 %high.2, %cross.1
  %high.4 = add i64 %high.3, %cross.2
  %product = mul i64 %a, %b
  store i64 %product, ptr %to
  %next = getelementptr i64, ptr %to, i32 1
  store i64 %high.4, ptr %next
  ret void
}
"""

_allow, _reset = allow, resetting(draw)


def find_linker() -> list[str]:
    """The command that links WebAssembly modules; an OSError that says what to install if there is none."""
    for name in LINKERS:
        if path := shutil.which(name):
            return [path]
    if find_spec("ziglang") is not None:
        return [sys.executable, "-m", "ziglang", "wasm-ld"]
    raise OSError("a WebAssembly module is linked by wasm-ld: install Debian's lld, or pip install --editable '.[web]'")


def describe(config: EnvConfig, env_id: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """What a page has to know about the module of a configuration, as plain JSON: see the beginning of this file."""
    world = WorldBatch(config, 1)
    scenario, record = world.scenario, world.state.dtype
    cars, rows = record["cars"].base, [OBJECTIVES[INDEX[name]] for name in world.objectives]
    return {
        **{"format": FORMAT, "id": env_id, "arguments": dict(arguments), "title": scenario.title},
        **{"scenario": scenario.name, "vehicles": scenario.vehicles, "frequency": config.decision_frequency},
        **{"continuous": world.continuous, "actionNames": list(action_sets.action_names(config.action_type))},
        **{"maxDecisions": config.max_decisions, "ends": list(ENDS)},
        "objectives": [{"key": each.name, "unit": each.unit, "sign": each.sign, "scale": each.scale} for each in rows],
        "observations": [{"name": each.name, "unit": each.unit, "scale": each.scale} for each in layout(scenario)],
        "state": {"size": record.itemsize, "fields": _fields(record)},
        "cars": {
            **{"offset": record.fields["cars"][1], "size": cars.itemsize, "count": scenario.cars},
            "fields": _fields(cars),
        },
        "obstacles": {"offset": record.fields["obstacle"][1], "count": scenario.obstacles},
    }


def _fields(record: Any) -> dict[str, list[Any]]:
    """[offset, type, count] of the numbers in a record."""
    numbers = ((name, *field[:2]) for name, field in record.fields.items() if not name.startswith("gap_"))
    return {
        name: [offset, kind.base.str[1:], int(np.prod(kind.shape, dtype=int))]
        for name, kind, offset in numbers
        if kind.base.names is None
    }


def _resident(name: str, array: np.ndarray) -> Any:
    """A compiled function that returns an array which is in the module, under ``name``, with these first contents."""
    kind = numba.typeof(array)  # type: ignore[no-untyped-call]

    @intrinsic
    def get(_context: Any) -> Any:
        def generate(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
            contents = bytearray(array.tobytes() or bytes(8))
            bytes_type = ir.ArrayType(ir.IntType(8), len(contents))
            data = builder.module.globals.get(name)
            if data is None:
                data = cgutils.add_global_variable(builder.module, bytes_type, name)  # type: ignore[no-untyped-call]
                data.linkage, data.align = "linkonce_odr", 16
                data.initializer = ir.Constant(bytes_type, contents if any(contents) else None)
            made = make_array(kind)(context, builder)  # type: ignore[no-untyped-call]
            populate_array(  # type: ignore[no-untyped-call]
                made,
                data=builder.bitcast(data, made.data.type),
                shape=[context.get_constant(types.intp, size) for size in array.shape],
                strides=[context.get_constant(types.intp, step) for step in array.strides],
                itemsize=context.get_constant(types.intp, array.itemsize),
                meminfo=None,
            )
            return made._getvalue()

        return kind(), generate

    return get


def _entries(config: EnvConfig) -> dict[str, Any]:
    """The functions that a module exports, each with its signature; they have one world between them."""
    world = WorldBatch(config, 1)
    vehicles, cars = world.scenario.vehicles, world.scenario.cars
    axes, number = ((3,), np.float32) if world.continuous else ((), np.int32)
    scratch = make_scratch(vehicles + cars, config.physics_steps)
    (
        worlds, actions, observations, rewards, acted, ended, timed_out, table, params, pins, controls, motion, path,
        others, sight, spawn, drawn, stream, waiting, counts, unfair,
    ) = map(
        _resident,
        (*ARRAYS, *(f"own_{k}" for k in range(14))),
        (
            world.state, np.zeros((1, vehicles, *axes), number), world.observations, world.rewards, world.acted,
            world.terminated, world.truncated, world.table, world.params, world.no_pins, np.zeros((1, vehicles, 3)),
            *scratch, traffic.make_scratch(cars), np.zeros(1, observation.SIGHT), np.zeros_like(world.no_pins),
            np.zeros((1, world.scenario.draws)), np.zeros(12, np.uint64), np.zeros(1, np.bool_),
            np.zeros(1, np.int64), np.zeros(1, np.int64),
        ),
    )  # fmt: skip
    decide, choices = world.step_function, len(world.table)
    choose = numba.njit(error_model="numpy")(action_sets.action_of_keys)

    def step() -> int:
        if not _allow(actions(), choices, 0):
            return 1
        decide(
            worlds(), actions(), table(), params(), controls(), motion(), others(), path(), sight(),
            observations(), rewards(), acted(), ended(), timed_out(),
        )  # fmt: skip
        return 0

    def restart() -> int:
        problem = _reset(
            worlds(), 0, waiting(), stream(), counts(), unfair(), drawn(), pins(), params(), spawn(), sight(),
            observations(), ended(), timed_out(),
        )  # fmt: skip
        return 0 if problem == DONE else 1

    def seed(value: Any) -> int:
        seed_stream(value, stream())
        return 0

    def keys(v: int, accelerate: int, brake: int, left: int, right: int) -> int:
        me = worlds()[0, v]
        return choose(table(), me.steer, me.speed, me.throttle, accelerate != 0, brake != 0, left != 0, right != 0)

    whole = types.int32
    made: dict[str, Any] = {"step": (step, whole()), "restart": (restart, whole()), "seed": (seed, whole(types.uint64))}
    return made if world.continuous else {**made, "keys": (keys, whole(*[whole] * 5))}


def compile_module(config: EnvConfig) -> bytes:
    """The WebAssembly module of a configuration.

    Raises:
        ValueError: if something of it cannot be compiled without Python, such as an objective that allocates.
        OSError: if there is no linker, or it fails.
    """
    linker = find_linker()
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(TARGET).create_target_machine(opt=3, features="+bulk-memory")
    whole = llvm.parse_assembly(f'target datalayout = "{LAYOUT}"\ntarget triple = "{TARGET}"\n{PRODUCT}')
    exported = _entries(config)
    for name, (function, signature) in exported.items():
        whole.link_in(_portable(name, function, signature))
    for function in whole.functions:
        if not function.is_declaration and function.name not in (*exported, "__multi3"):
            function.linkage = "internal"
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=3))
    builder.getModulePassManager().run(whole, builder)
    missing = {each.name for each in whole.functions if each.is_declaration and not each.name.startswith("llvm.")}
    if foreign := sorted(name for name in missing if name not in MATHS):
        raise ValueError(
            f"{config.scenario}: an objective cannot be compiled for a browser, since it needs {', '.join(foreign)}: "
            "a measure there computes with numbers alone, and makes no arrays, texts or errors"
        )
    with tempfile.TemporaryDirectory() as folder:
        source, target, known = (Path(folder, name) for name in ("world.o", "world.wasm", "maths"))
        source.write_bytes(machine.emit_object(whole))
        known.write_text("\n".join(MATHS))
        exports = [f"--export={name}" for name in (*exported, *ARRAYS)]
        exports.append(f"--allow-undefined-file={known}")
        done = subprocess.run(
            [*linker, *LINK_OPTIONS, *exports, "-o", str(target), str(source)],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise OSError(f"{' '.join(linker)} failed: {' '.join(done.stderr.split())[:300]}")
        return target.read_bytes()


_C_TYPES = {types.int32: "i32", types.uint64: "i64"}


def _portable(name: str, function: Callable[..., Any], signature: Any) -> Any:
    """A function as LLVM code for WebAssembly, with a wrapper under ``name`` that returns its result."""
    try:
        compiled = numba.njit(signature, error_model="numpy", nogil=True)(function)
    except Exception as error:
        raise ValueError(f"the world cannot be compiled for a browser: {reason(error)}") from None
    result = compiled.overloads[compiled.signatures[0]]
    inner = result.fndesc.llvm_func_name
    kinds = [_C_TYPES[each] for each in signature.args]
    declared = "".join(f", {kind} %a{k}" for k, kind in enumerate(kinds))
    text = result.library.get_llvm_str()
    text = re.sub(r'"(?:target-cpu|target-features|tune-cpu|probe-stack)"="[^"]*"', "", text)
    text = re.sub(r"^target (datalayout|triple) = .*$", "", text, flags=re.MULTILINE)
    text = f'target datalayout = "{LAYOUT}"\ntarget triple = "{TARGET}"\n{text}'
    text = text.replace("= common ", "= linkonce_odr ")
    text += f"""
define i32 @{name}({declared[2:]}) {{
  %result = alloca i32
  %error = alloca ptr
  %status = call i32 @{inner}(ptr %result, ptr %error{declared})
  %value = load i32, ptr %result
  ret i32 %value
}}
"""
    return llvm.parse_assembly(text)
