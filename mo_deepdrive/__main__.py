"""The command line: ``mo-deepdrive train ...``, or ``python -m mo_deepdrive train ...``.

The commands are in the package ``algorithms``, whose name many projects give to a folder of their own. So it is loaded
from beside this package, wherever Python would find one of that name first: in the working directory, on PYTHONPATH or
among the installed packages. That happens on import, because worker processes import the main module, too.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING

from mo_deepdrive.support.importing import load_own, own_algorithms

if TYPE_CHECKING:
    from collections.abc import Callable


def load_algorithms() -> None:
    """Make ``algorithms`` the package that belongs to this one, for all imports in this process."""
    spec, loaded = own_algorithms(), sys.modules.get("algorithms")
    if getattr(loaded, "__file__", None) == spec.origin:
        return
    for name in [name for name in sys.modules if name.partition(".")[0] == "algorithms"]:
        del sys.modules[name]
    load_own(spec)


load_algorithms()


def call(function: Callable[[], None]) -> None:
    """Call what a new process begins with; to find this, it imports this module before any of ``algorithms``."""
    function()


def run(name: str | None = None) -> int:
    """Run a command with the command line of this process, which begins with its name if that is None."""
    code: int = importlib.import_module("algorithms.command_line").run(name, sys.argv[1:])
    return code


if __name__ == "__main__":
    sys.exit(run())
