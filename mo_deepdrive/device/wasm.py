"""One world as a WebAssembly module, from the functions that move it on a CPU.

Numba makes LLVM code of the kernel, llvmlite an object file of it, and ``wasm-ld`` a module of some 100 kB. All arrays
are in the module, with their first contents. ``docs/page_files.md`` says what it exports.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections import namedtuple
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
from mo_deepdrive.device.pcg64 import STREAM, draw, seed_stream
from mo_deepdrive.simulation.autoreset import DONE, resetting
from mo_deepdrive.world import actions as action_sets
from mo_deepdrive.world.batch import WorldBatch
from mo_deepdrive.world.measures import reason

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from mo_deepdrive.world.config import EnvConfig

TARGET = "wasm32-unknown-unknown"
EXPORTED = ("worlds", "actions", "observations", "rewards", "acted", "ended", "timed_out")
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

_reset = resetting(draw)
_choose = numba.njit(error_model="numpy")(action_sets.action_of_keys)


def find_linker() -> list[str]:
    """The command that links WebAssembly modules; an OSError that says what to install if there is none."""
    if path := shutil.which("wasm-ld"):
        return [path]
    if find_spec("ziglang") is not None:
        return [sys.executable, "-m", "ziglang", "wasm-ld"]
    raise OSError("a WebAssembly module is linked by wasm-ld: install Debian's lld, or pip install --editable '.[web]'")


def _resident(arrays: Mapping[str, np.ndarray]) -> Any:
    """A compiled function that returns arrays which are in the module, by their names, with these first contents."""
    kinds = [numba.typeof(array) for array in arrays.values()]  # type: ignore[no-untyped-call]
    named = types.NamedTuple(kinds, namedtuple("Arrays", arrays))  # type: ignore[no-untyped-call]

    def put(context: Any, builder: Any, name: str, array: np.ndarray, kind: Any) -> Any:
        contents = bytearray(array.tobytes() or bytes(8))
        data = builder.module.globals.get(name)
        if data is None:
            kept = ir.ArrayType(ir.IntType(8), len(contents))
            data = cgutils.add_global_variable(builder.module, kept, name)  # type: ignore[no-untyped-call]
            data.linkage, data.align = "linkonce_odr", 16
            data.initializer = ir.Constant(kept, contents if any(contents) else None)
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

    @intrinsic
    def get(_context: Any) -> Any:
        def generate(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
            parts = zip(arrays.items(), kinds, strict=True)
            return context.make_tuple(builder, named, [put(context, builder, *item, kind) for item, kind in parts])

        return named(), generate

    return get


def _entries(config: EnvConfig) -> dict[str, tuple[Callable[..., int], Sequence[Any]]]:
    """The functions that a module exports, and the types of their arguments; they have one world between them."""
    world = WorldBatch(config, 1)
    decide, choices, (part,) = world.step_function, len(world.table), world.parts(1)
    axes, number = ((3,), np.float32) if world.continuous else ((), np.int32)
    arrays = {
        **{"worlds": part.worlds, "observations": part.observations, "rewards": part.rewards, "acted": part.acted},
        **{"ended": part.terminated, "timed_out": part.truncated, "table": world.table, "params": world.params},
        **{"motion": part.motion, "cars": part.cars, "path": part.path, "sight": part.sight, "spawn": part.spawn},
        **{"controls": part.controls, "pins": world.no_pins, "drawn": np.zeros((1, world.scenario.draws))},
        **{"unfair": np.zeros(1, np.int64), "waiting": np.zeros(1, np.bool_), "stream": np.zeros(STREAM, np.uint64)},
        "actions": np.zeros((*part.acted.shape, *axes), number),
    }
    resident = _resident(arrays)

    def step() -> int:
        b = resident()
        if not allow(b.actions, choices, 0):
            return 1
        decide(
            b.worlds, b.actions, b.table, b.params, b.controls, b.motion, b.cars, b.path, b.sight, b.observations,
            b.rewards, b.acted, b.ended, b.timed_out,
        )  # fmt: skip
        return 0

    def restart() -> int:
        b = resident()
        problem = _reset(
            b.worlds, 0, b.waiting, b.stream, b.unfair, b.unfair, b.drawn, b.pins, b.params, b.spawn, b.sight,
            b.observations, b.ended, b.timed_out,
        )  # fmt: skip
        return 0 if problem == DONE else 1

    def seed(value: Any) -> int:
        seed_stream(value, resident().stream)
        return 0

    def keys(v: int, accelerate: int, brake: int, left: int, right: int) -> int:
        b = resident()
        me = b.worlds[0, v]
        return _choose(b.table, me.steer, me.speed, me.throttle, accelerate != 0, brake != 0, left != 0, right != 0)

    made: dict[str, Any] = {"step": (step, ()), "restart": (restart, ()), "seed": (seed, (types.uint64,))}
    return made if world.continuous else {**made, "keys": (keys, 5 * (types.int32,))}


def compile_module(config: EnvConfig) -> bytes:
    """The WebAssembly module of a configuration.

    Raises:
        ValueError: if something of it cannot be compiled without Python, such as an objective that allocates.
        OSError: if there is no linker, or it fails.
    """
    linker, exported = find_linker(), _entries(config)
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(TARGET).create_target_machine(opt=3, features="+bulk-memory")
    whole = llvm.parse_assembly(PRODUCT)
    whole.triple, whole.data_layout = TARGET, str(machine.target_data)
    for name, (function, arguments) in exported.items():
        part = llvm.parse_assembly(_assembly(name, function, arguments))
        part.triple, part.data_layout = whole.triple, whole.data_layout
        whole.link_in(part)
    for function in whole.functions:
        if not function.is_declaration and function.name not in (*exported, "__multi3"):
            function.linkage = "internal"
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=3))
    builder.getModulePassManager().run(whole, builder)
    missing = {each.name for each in whole.functions if each.is_declaration and not each.name.startswith("llvm.")}
    if foreign := sorted(missing.difference(MATHS)):  # LLVM aborts the process where it makes an object file of such
        raise ValueError(
            f"{config.scenario}: an objective cannot be compiled for a browser: it needs {', '.join(foreign)}, but "
            "a measure there computes with numbers alone, and makes no arrays, texts or errors"
        )
    with tempfile.TemporaryDirectory() as folder:
        source, target, known = (Path(folder, name) for name in ("world.o", "world.wasm", "maths"))
        source.write_bytes(machine.emit_object(whole))
        known.write_text("\n".join(MATHS))
        names = [f"--export={name}" for name in (*exported, *EXPORTED)]
        files = [f"--allow-undefined-file={known}", "-o", str(target), str(source)]
        done = subprocess.run([*linker, *LINK_OPTIONS, *names, *files], capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{' '.join(linker)} failed: {' '.join(done.stderr.split())[:300]}")
        return target.read_bytes()


def _assembly(name: str, function: Callable[..., int], arguments: Sequence[Any]) -> str:
    """A function as LLVM code for any machine, with a wrapper under ``name`` that returns its result."""
    try:
        compiled = numba.njit(types.int32(*arguments), error_model="numpy", nogil=True)(function)
    except Exception as error:  # Numba raises errors of many kinds
        raise ValueError(f"the world cannot be compiled for a browser: {reason(error)}") from None
    (result,) = compiled.overloads.values()
    text = re.sub(r'"(?:target-cpu|target-features|tune-cpu|probe-stack)"="[^"]*"', "", result.library.get_llvm_str())
    given = "".join(f", i{kind.bitwidth} %a{k}" for k, kind in enumerate(arguments))
    return f"""{text.replace("= common ", "= linkonce_odr ")}
define i32 @{name}({given[2:]}) {{
  %result = alloca i32
  %error = alloca ptr
  %status = call i32 @{result.fndesc.llvm_func_name}(ptr %result, ptr %error{given})
  %value = load i32, ptr %result
  ret i32 %value
}}
"""
