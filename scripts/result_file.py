"""Checks of options that several scripts have."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from pathlib import Path


def check_least(parser: ArgumentParser, options: Namespace, least: int, *names: str) -> None:
    """Exit with a message unless the named options are at least ``least``; those that are None do not count."""
    for name in names:
        value = getattr(options, name)
        if value is not None and value < least:
            parser.error(f"--{name} {value} must be at least {least}")


def check_folder(parser: ArgumentParser, path: Path | None) -> None:
    """Exit with a message unless ``--output`` can be written, before any work is done."""
    if path is not None and not path.parent.is_dir():
        parser.error(f"--output {path}: there is no folder {path.parent}")
