"""The one compiler decorator of the package.

Numba keys a cached function by its own source file, so a function goes stale when a function that
it *imports* changes. Here every function is keyed by a hash of all sources of the package instead.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import caching

F = TypeVar("F", bound=Callable[..., Any])


def source_hash(package: Path) -> str:
    """SHA-256 over the names and contents of every ``.py`` file below ``package``."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


SOURCES = source_hash(Path(__file__).parent.parent)


class _PackageStamp:
    def get_source_stamp(self) -> str:
        return SOURCES


class _UserProvided(_PackageStamp, caching.UserProvidedCacheLocator):
    pass


class _InTree(_PackageStamp, caching.InTreeCacheLocator):
    pass


class _UserWide(_PackageStamp, caching.UserWideCacheLocator):
    pass


class _CacheImpl(caching.CompileResultCacheImpl):
    _locator_classes = [_UserProvided, _InTree, _UserWide]


class _Cache(caching.FunctionCache):
    _impl_class = _CacheImpl


def jit(function: F) -> F:
    """Compile ``function`` in nopython mode, without the GIL, with IEEE arithmetic and a disk cache.

    Functions are inlined into their callers: a call passes every array as seven words and counts a reference.
    Where no cache folder is writable the function is compiled anew in every process.
    """
    compiled: Any = numba.njit(nogil=True, error_model="numpy", forceinline=True)(function)
    if not numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        try:
            compiled._cache = _Cache(function)
        except RuntimeError as error:
            if "no locator available" not in str(error):
                raise
    return compiled
