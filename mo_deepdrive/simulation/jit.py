"""The compiler decorator of the package.

Numba caches a function under the stamp of its own source file, so the cache becomes stale when a function that it
*imports* changes. Here the stamp of every function is a hash of all sources of its package, of the packages of compiled
functions that it calls, and of this one.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import caching, types
from numba.core.dispatcher import Dispatcher

F = TypeVar("F", bound=Callable[..., Any])


def source_hash(package: Path) -> str:
    """SHA-256 over the names and contents of every ``.py`` file below ``package``."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


_hash_once = functools.cache(source_hash)
HERE = Path(__file__).parent


def _held(function: Any) -> list[Any]:
    """What a function has from the function that made it."""
    return [cell.cell_contents for cell in function.__closure__ or ()]


@functools.cache
def _folders(function: Any) -> frozenset[Path]:
    """Where the sources of a function are, and of the compiled functions that it calls."""
    named = (function.__globals__.get(name) for name in function.__code__.co_names)
    called = (each.py_func for each in (*named, *_held(function)) if isinstance(each, Dispatcher))
    return frozenset({Path(function.__code__.co_filename).parent}).union(*map(_folders, called))


def _closure(function: Any) -> list[Any]:
    """What a function holds: of compiled functions, whose code is in the stamp, their names and what these hold."""
    return [
        (each.py_func.__module__, each.py_func.__qualname__, _closure(each.py_func))
        if isinstance(each, Dispatcher)
        else each
        for each in _held(function)
    ]


def _can_be_cached(function: Any) -> bool:
    """Whether all compiled functions that a function holds are of :func:`jit`: changes of others go unnoticed."""
    return all(isinstance(vars(each)["_cache"], _Cache) for each in _held(function) if isinstance(each, Dispatcher))


class _PackageStamp:
    def __init__(self, function: Any, file: str):
        super().__init__(function, file)  # type: ignore[call-arg]  # of Numba's class
        self._others = sorted(_folders(function) - {HERE})

    def get_source_stamp(self) -> str:
        return "".join(map(_hash_once, [HERE.parent, *self._others]))


class _UserProvided(_PackageStamp, caching.UserProvidedCacheLocator):
    pass


class _InTree(_PackageStamp, caching.InTreeCacheLocator):
    pass


class _UserWide(_PackageStamp, caching.UserWideCacheLocator):
    pass


class _CacheImpl(caching.CompileResultCacheImpl):
    _locator_classes = [_UserProvided, _InTree, _UserWide]


class _Files(caching.IndexDataCacheFile):
    """The files of a cache, with names that tell versions apart.

    Numba counts them: of two processes that compile at the same time, or with other sources, one may then load what
    the other has written under the same number, and crash.
    """

    def save(self, key: Any, data: Any) -> None:
        index: dict[Any, str] = self._load_index()  # type: ignore[no-untyped-call]  # Numba has no types
        pattern = self._data_name_pattern.replace("{number:d}", "{}")
        if not index:
            for outdated in Path(self._cache_path).glob(pattern.format("*")):
                outdated.unlink(missing_ok=True)
        name = pattern.format(hashlib.sha256(repr((self._source_stamp, key)).encode()).hexdigest()[:16])
        self._save_data(name, data)  # type: ignore[no-untyped-call]
        self._save_index({**index, key: name})  # type: ignore[no-untyped-call]


class _Cache(caching.FunctionCache):
    """A cache whose broken files, such as those of a full disk, are as good as absent."""

    _impl_class = _CacheImpl

    def __init__(self, function: Any):
        super().__init__(function)  # type: ignore[no-untyped-call]
        locator = self._impl.locator
        self._cache_file = _Files(self._cache_path, self._impl.filename_base, locator.get_source_stamp())  # type: ignore[no-untyped-call]

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        """As Numba's, which would tell functions in a closure apart by the process that made them.

        A module may have been imported under another name, which compiled code refers to.
        """
        code, names = self._py_func.__code__.co_code, repr((self._py_func.__module__, _closure(self._py_func)))
        return sig, codegen.magic_tuple(), hashlib.sha256(code + names.encode()).hexdigest()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]  # Numba has no types
        except Exception:  # whatever unpickling a truncated file raises
            try:
                self.flush()  # type: ignore[no-untyped-call]
            except OSError:
                self.disable()  # type: ignore[no-untyped-call]
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        # The function has been compiled; without its file the next process compiles it again.
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]


def jit(function: F) -> F:
    """Compile ``function`` in nopython mode, without the GIL, with IEEE arithmetic and a disk cache.

    Functions are inlined into their callers, because a call passes every array as seven words and counts a reference.
    If no cache directory is writable, the function is compiled in every process; so is one that holds a compiled
    function of somebody else in its closure.

    Args:
        function: the function; its annotations are for readers and type checkers alone.

    Returns:
        The compiled function, with the type of ``function``.
    """
    return _compiled(function, forceinline=True)


def separate_jit(function: F) -> F:
    """As :func:`jit`, but calls remain calls, so that large functions are compiled once and not in every caller."""
    return _compiled(function)


def uncounted_jit(function: F) -> F:
    """As :func:`jit`, without counting references, for functions that use tuples of arrays within loops.

    They must not keep or allocate anything.
    """
    return _compiled(function, forceinline=True, _nrt=False)


def _compiled(function: F, **options: Any) -> F:
    compiled: Any = numba.njit(nogil=True, error_model="numpy", **options)(function)
    if not numba.config.DISABLE_JIT and _can_be_cached(function):  # type: ignore[attr-defined]  # Numba has no types
        try:
            compiled._cache = _Cache(function)
        except RuntimeError as error:
            if "no locator available" not in str(error):
                raise
    return cast("F", compiled)


class Pointer(types.WrapperAddressProtocol):
    """A pointer to a compiled function, for arguments of compiled functions.

    A function that is passed as it is would be compiled again within what it is passed to, or its address looked up at
    every call.

    Args:
        function: the function.
        arguments: like those that it will be called with.
    """

    def __init__(self, function: Any, arguments: Sequence[Any]):
        signature = tuple(map(numba.typeof, arguments))
        function.compile(signature)
        compiled = function.overloads[signature]
        self.type = types.FunctionType(compiled.signature.return_type(*signature))
        self._function = function  # keeps the code alive
        self._address = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cfunc_wrapper_name)

    def __wrapper_address__(self) -> int:
        return int(self._address)

    def signature(self) -> Any:
        """Of the function."""
        return self.type.signature
