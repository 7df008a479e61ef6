"""Importing what a user names: a module, or ``package.module:name``."""

from __future__ import annotations

import importlib
import sys
import sysconfig
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mo_deepdrive.names import nearest

if TYPE_CHECKING:
    from types import ModuleType


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
    module = import_module(what, module_name)
    if not hasattr(module, name):
        own = [each for each, value in vars(module).items() if getattr(value, "__module__", None) == module_name]
        raise ValueError(f"{what}: {module_name!r} has no {name!r}; {nearest(name, own)}")
    return getattr(module, name)


def import_module(what: str, name: str) -> ModuleType:
    """The module ``name``.

    Args:
        what: names it, for messages.
        name: of the module.

    Raises:
        ValueError: in one line, if it cannot be imported; if there is none, with the places where it was looked for.
    """
    try:
        return importlib.import_module(name)
    except Exception as error:  # a user's module may raise anything, such as SyntaxError
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        if isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}."):
            reason += f"; looked for in {', '.join([*_own_folders(), 'the installed packages'])}"
        raise ValueError(f"{what}: {name!r} cannot be imported: {reason}") from error


def _own_folders() -> list[str]:
    """The folders of ``sys.path`` without those of Python and of installed packages."""
    places = sysconfig.get_paths()
    installed = {Path(places[name]) for name in ("stdlib", "platstdlib", "purelib", "platlib", "scripts")}
    folders = [path for path in dict.fromkeys(Path(each).absolute() for each in sys.path) if path.is_dir()]
    return [repr(str(path)) for path in folders if not installed & {path, *path.parents}]
