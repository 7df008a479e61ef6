"""The command line: ``mo-deepdrive train ...``, or ``python -m algorithms train ...``."""

from __future__ import annotations

import argparse
import importlib
import os
import sys

import mo_deepdrive
from algorithms.commands import COMMANDS
from algorithms.experiments.cli import INSTALLED, INVALID_INPUT, PROCESS_DEFAULTS, prepare_process
from mo_deepdrive.extras import MissingExtraError, needed_for


def main() -> int:
    """``mo-deepdrive``; returns the exit code."""
    return _run(sys.argv[1:], INSTALLED)


def run_script(name: str) -> int:
    """``python scripts/NAME.py``; returns the exit code."""
    return _run_command(name, sys.argv[1:], "python scripts/{}.py")


def _run(arguments: list[str], program: str) -> int:
    """Run a command line that begins with the name of the command."""
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
    return _run_command(parser.parse_args(arguments[:1]).command, arguments[1:], program)


def _run_command(name: str, arguments: list[str], program: str) -> int:
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


if __name__ == "__main__":
    sys.exit(_run(sys.argv[1:], "python -m algorithms {}"))
