"""The command line below ``mo_deepdrive/__main__.py``: finds and runs a command."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from typing import TYPE_CHECKING

import mo_deepdrive
from algorithms.commands import COMMANDS
from algorithms.experiments.cli import INVALID_INPUT, PROCESS_DEFAULTS, prepare_process
from mo_deepdrive.extras import MissingExtraError, needed_for

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(arguments: Sequence[str], program: str) -> int:
    """Run a command line that begins with the name of the command; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog=program.format("").strip(),
        usage="%(prog)s COMMAND ...",
        description="Multi-objective driving environments, and trainers for them.",
        epilog="\n".join(
            ["commands:", *(f"  {name:12}{what}" for name, what in COMMANDS.items()), "", "COMMAND --help: its options"]
        ),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"mo-deepdrive {mo_deepdrive.__version__}")
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help="one of those below")
    return run_command(parser.parse_args(arguments[:1]).command, arguments[1:], program)


def run_command(name: str, arguments: Sequence[str], program: str) -> int:
    """Import and run a command; a package that is not installed is an error of the user's input."""
    try:
        with needed_for(program.format(name)):
            module = importlib.import_module(f"algorithms.commands.{name}")
            prepare_process(os.environ, sys.path, getattr(module, "ENVIRONMENT", PROCESS_DEFAULTS))
            code: int = module.main(arguments, program)
    except MissingExtraError as error:
        print(f"error: {error}", file=sys.stderr)
        return INVALID_INPUT
    return code
