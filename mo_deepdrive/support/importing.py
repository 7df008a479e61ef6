"""Importing what a user names, a module or ``package.module:name``, and the package ``algorithms`` of this one."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import sysconfig
import traceback
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mo_deepdrive.support.names import nearest

if TYPE_CHECKING:
    from types import ModuleType


def import_named(key: str, path: str) -> Any:
    """The object that a setting ``key``, such as "algorithm.network", names as ``package.module:name``.

    Raises:
        ValueError: in one line, if the path has another form, the module cannot be imported or lacks the name.
    """
    what = f"{key} = {path!r}"
    module_name, _, name = path.partition(":")
    if not module_name or not name:
        raise ValueError(f"{what} must have the form package.module:name")
    return first_of(what, import_module(what, module_name), name)


def first_of(what: str, module: ModuleType, *names: str) -> Any:
    """The first of some names that a module defines; a ValueError that begins with ``what`` if it has none of them."""
    for name in names:
        if hasattr(module, name):
            return getattr(module, name)
    defined = [name for name, value in vars(module).items() if getattr(value, "__module__", None) == module.__name__]
    missing = " or ".join(map(repr, names))
    raise ValueError(f"{what}: {module.__name__!r} has no {missing}; {nearest(names[0], defined)}")


def import_file(what: str, path: Path) -> ModuleType:
    """The module in a file; a ValueError that begins with ``what`` if it cannot be imported."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise ValueError(f"{what} cannot be imported: {failure(error)}") from error
    return module


def import_module(what: str, name: str) -> ModuleType:
    """The module ``name``; a ValueError in one line that begins with ``what`` if it cannot be imported.

    If there is none, the error has the places where it was looked for.
    """
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:  # a user's module may raise anything, such as SyntaxError
        reason = failure(error)
        if isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}."):
            reason += f"; looked for in {', '.join([*_own_folders(), 'the installed packages'])}"
        raise ValueError(f"{what}: {name!r} cannot be imported: {reason}") from error


def failure(error: BaseException) -> str:
    """An error of a user's code, just caught, in one line with the file and line of that code, where they are known."""
    ours = ("<frozen ", str(importlib.__file__), str(Path(__file__).parents[1]))
    frames = traceback.extract_tb(error.__traceback__)[1:]  # without the caller
    theirs = [frame for frame in frames if not frame.filename.startswith(ours)]
    last = next((frame for frame in reversed(theirs) if frame.filename == theirs[0].filename), None)
    where = f" at {Path(last.filename).name}:{last.lineno}" if last else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())}{where}"


def own_algorithms() -> ModuleSpec:
    """The package ``algorithms`` beside this one, wherever Python would find one of that name first."""
    root = str(Path(__file__).parents[2])
    spec = PathFinder.find_spec("algorithms", [root])
    if spec is None or spec.loader is None:
        raise ImportError(f"{root!r} has no package algorithms: reinstall mo-deepdrive")
    return spec


def load_own(spec: ModuleSpec | None) -> ModuleType:
    """Load the package ``algorithms`` of this one under the name of ``spec``."""
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = module_from_spec(spec)
    spec.loader.exec_module(module)
    if not hasattr(module, "ALGORITHMS"):
        raise ImportError(f"{spec.origin!r} is another project's, installed over mo-deepdrive's: separate them")
    return module


def _own_folders() -> list[str]:
    """The folders of ``sys.path`` without those of Python and of installed packages."""
    places = sysconfig.get_paths()
    installed = {Path(places[name]) for name in ("stdlib", "platstdlib", "purelib", "platlib", "scripts")}
    folders = [path for path in dict.fromkeys(Path(entry).absolute() for entry in sys.path) if path.is_dir()]
    return [repr(str(path)) for path in folders if not installed & {path, *path.parents}]
