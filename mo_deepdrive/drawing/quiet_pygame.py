"""pygame, imported without the greeting that it prints: standard output belongs to the program."""

from __future__ import annotations

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    import pygame
    from pygame import gfxdraw

__all__ = ["INVISIBLE_DRIVERS", "gfxdraw", "pygame"]

INVISIBLE_DRIVERS = ("dummy", "offscreen")  # SDL's video drivers without a display
