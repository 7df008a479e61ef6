"""Importing what a setting names by its dotted path, ``package.module:name``."""

from __future__ import annotations

import importlib
from typing import Any

from mo_deepdrive.config import nearest


def import_named(key: str, path: str) -> Any:
    """The object that a setting names.

    Args:
        key: of the setting, for messages, such as "algorithm.network".
        path: its value, ``package.module:name``.

    Raises:
        ValueError: in one line, if the path has another form, the module cannot be imported or lacks the name.
    """
    what = f"{key} = {path!r}"
    module_name, _, name = path.partition(":")
    if not module_name or not name:
        raise ValueError(f"{what} must have the form package.module:name")
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # a user's module may raise anything, such as SyntaxError
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ValueError(f"{what}: {module_name!r} cannot be imported: {reason}") from error
    if not hasattr(module, name):
        own = [each for each, value in vars(module).items() if getattr(value, "__module__", None) == module_name]
        raise ValueError(f"{what}: {module_name!r} has no {name!r}; {nearest(name, own)}")
    return getattr(module, name)
