"""The learners, by a name that no other project has: ``from mo_deepdrive.learners import MOPPO``.

They are the package ``algorithms`` beside this one, whose modules have names here, too, such as
``mo_deepdrive.learners.agent``. Many projects have a folder ``algorithms`` of their own. Where Python finds ours under
that name, both names mean the same modules; otherwise ours is loaded under this name alone, beside the other one.
"""

from __future__ import annotations

import importlib
import sys
from importlib import util
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import FileFinder, ModuleSpec, SourceFileLoader
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mo_deepdrive.support.importing import load_own, own_algorithms

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import ModuleType

    def __getattr__(name: str) -> Any: ...


class _Renamed(SourceFileLoader):
    """Loads a module of ours that finds the others by their names here."""

    def path_stats(self, path: Any) -> Any:
        raise OSError(f"the bytecode of {path} finds the others by their first names")

    def source_to_code(self, data: Any, path: Any, **options: Any) -> Any:  # type: ignore[override]
        for before in ("from algorithms", '"algorithms.'):
            data = data.replace(before.encode(), before.replace("algorithms", __name__).encode())
        return super().source_to_code(data, path, **options)


class _Alias(Loader):
    """Gives a module of ours its second name."""

    def __init__(self, module: ModuleType):
        self._module, self._spec = module, module.__spec__

    def create_module(self, _spec: ModuleSpec) -> ModuleType:
        return self._module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec


class _Finder(MetaPathFinder):
    """Finds the modules of ours by their names here."""

    def __init__(self, *, alias: bool):
        self._alias = alias

    def find_spec(self, name: str, path: Sequence[str] | None, _target: ModuleType | None = None) -> ModuleSpec | None:
        if path is None or not name.startswith(f"{__name__}."):
            return None
        if self._alias:
            ours = f"algorithms{name.removeprefix(__name__)}"
            return ModuleSpec(name, _Alias(importlib.import_module(ours))) if util.find_spec(ours) else None
        return FileFinder(path[0], (_Renamed, [".py"])).find_spec(name)


def _load() -> None:
    """Replace this module by the package."""
    own, loaded = own_algorithms(), sys.modules.get("algorithms")
    origin = str(own.origin)
    found = getattr(loaded, "__file__", None) if loaded else getattr(util.find_spec("algorithms"), "origin", None)
    alias = found is not None and Path(found).resolve() == Path(origin).resolve()
    sys.meta_path.insert(0, _Finder(alias=alias))
    if alias:
        sys.modules[__name__] = loaded or load_own(own)
    else:
        load_own(util.spec_from_file_location(__name__, loader=_Renamed(__name__, origin)))


_load()
