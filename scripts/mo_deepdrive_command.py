"""Where ``mo-deepdrive`` and the scripts start: until the rest is imported, Ctrl-C ends the process with one line.

It is installed beside the packages, because ``mo_deepdrive`` imports NumPy and Gymnasium.
"""

from __future__ import annotations

import os
import signal


def main(name: str | None = None) -> int:
    """Run a command with the command line of this process, which begins with its name if that is None."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else a shell has set it, of a background job
        signal.signal(signal.SIGINT, _end)
    from mo_deepdrive.__main__ import run

    return run(name)


def _end(*_: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(130)
