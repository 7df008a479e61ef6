"""The command line below ``mo_deepdrive/__main__.py``: finds and runs a command.

Everything that takes time to import is imported where Ctrl-C is handled already.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from algorithms.runs.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import FrameType


def run(name: str | None, arguments: list[str]) -> int:
    """Run a command, whose ``arguments`` begin with its name if that is None; returns the exit code.

    Nothing but an error of the program ends with a traceback. A closed terminal does not end it, and output that cannot
    be written is dropped; that is an error of those commands alone whose result is what they print.
    """
    handlers = {}
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as a shell sets it for a background job
        handlers[signal.SIGINT] = signal.signal(signal.SIGINT, _interrupt)
    if hasattr(signal, "SIGHUP"):
        handlers[signal.SIGHUP] = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        from algorithms.runs.console import lost_output, make_standard_streams_lenient

        make_standard_streams_lenient()
        try:
            code = _run_command(name, arguments)
        except SystemExit as end:
            if isinstance(end.code, str):
                raise
            code = end.code or 0
        error = lost_output()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)  # what is left to do needs no traceback
    if error is None or isinstance(error, BrokenPipeError):  # the reader, such as head, has had enough
        return code
    from algorithms.commands import PRINTING_COMMANDS, PRINTING_OPTIONS

    is_result = (name or next(iter(arguments), "")) in PRINTING_COMMANDS
    lost = is_result or not PRINTING_OPTIONS.isdisjoint(arguments)
    print(f"{'error' if lost else 'warning'}: the output could not be written: {error}", file=sys.stderr)
    return 1 if lost and code == 0 else code


def _interrupt(_number: int, frame: FrameType | None) -> None:
    """End at once if something is being imported, when nothing needs to be saved; otherwise raise KeyboardInterrupt.

    Packages that are interrupted while they are imported raise other errors, or print tracebacks and go on.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            with contextlib.suppress(OSError):
                os.write(2, b"interrupted\n")
            os._exit(INTERRUPTED)
        frame = frame.f_back
    raise KeyboardInterrupt


def _run_command(name: str | None, arguments: list[str]) -> int:
    """Import and run a command; a package that is not installed is an error of the user's input."""
    import importlib

    from algorithms.runs.cli import INVALID_INPUT, PROCESS_DEFAULTS, warn
    from mo_deepdrive.support.extras import MissingExtraError, needed_for

    if name is None:
        name, arguments = _command(arguments), arguments[1:]
    try:
        with needed_for(f"mo-deepdrive {name}"):
            module: Any = importlib.import_module(f"algorithms.commands.{name}")
            prepare_process(getattr(module, "ENVIRONMENT", PROCESS_DEFAULTS))
            return int(module.main(arguments))
    except MissingExtraError as error:
        warn(f"error: {error}")
        return INVALID_INPUT


def prepare_process(defaults: Mapping[str, str]) -> None:
    """Set a process's environment, ``defaults`` unless the user has, and where a user's modules are imported from."""
    for name, value in defaults.items():
        os.environ.setdefault(name, value)
    # Not the user's choice: figures are drawn into files, and the backend of a notebook, whose cell calls the command,
    # may not be there.
    os.environ["MPLBACKEND"] = "agg"
    sys.path.append(str(Path.cwd()))  # at its end, so that no folder in it hides an installed package


def _command(arguments: list[str]) -> str:
    """The name of the command with which a command line begins."""
    import mo_deepdrive
    from algorithms.commands import COMMANDS
    from algorithms.runs.cli import first_word, make_parser

    parser = make_parser("Multi-objective driving environments, and trainers for them.")
    parser.prog, parser.usage = "mo-deepdrive", "%(prog)s COMMAND ..."
    parser.add_argument("--version", action="version", version=f"mo-deepdrive {mo_deepdrive.__version__}")
    return first_word(parser, "command", COMMANDS, arguments)
