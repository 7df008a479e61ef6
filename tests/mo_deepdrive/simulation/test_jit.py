"""The cache of compiled functions: stamped with the sources, and broken files are compiled again."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest

from mo_deepdrive.simulation.jit import jit, source_hash

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")


def triple(x: float) -> float:
    return 3.0 * x


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty directory of compiled functions."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def compiled() -> str:
    """Call the function in a new dispatcher, as a new process does: "loaded" from the cache, or "compiled"."""
    function: Any = jit(triple)
    assert function(2.0) == 6.0
    return "loaded" if function.stats.cache_hits else "compiled"


def cached(cache: Path, suffix: str) -> Path:
    (path,) = cache.rglob(f"*.{suffix}")
    return path


@pytest.mark.parametrize("kept", [0.0, 0.01, 0.5, 0.99])
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_a_truncated_cache_file_is_compiled_again(cache: Path, suffix: str, kept: float) -> None:
    assert [compiled(), compiled()] == ["compiled", "loaded"]
    path = cached(cache, suffix)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    assert [compiled(), compiled()] == ["compiled", "loaded"]
    assert abs(len(cached(cache, suffix).read_bytes()) - len(whole)) < 100


@pytest.mark.parametrize("broken", ["", "nbi", "nbc"])
def test_a_cache_that_cannot_be_written_is_no_error(cache: Path, broken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if broken:
        compiled()
        cached(cache, broken).write_bytes(b"")

    def fail(*_: Any) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", fail)
    assert [compiled(), compiled()] == ["compiled", "compiled"]


def test_the_stamp_depends_on_the_names_and_the_contents_of_all_sources(tmp_path: Path) -> None:
    stamps = set()
    for name, text in (("a.py", "1"), ("a.py", "2"), ("b.py", ""), ("below/c.py", ""), ("note.txt", "")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
        stamps.add(source_hash(tmp_path))
    assert len(stamps) == 4


@pytest.mark.slow
def test_sources_that_are_written_anew_with_the_same_contents_need_no_compilation(
    cache: Path, run_python: Callable[[str], str]
) -> None:
    """As in a container that is built again; Numba's own stamp is the time of the last change."""
    (cache / "code").mkdir()
    found = []
    for seconds in (1_000_000_000, 1_500_000_000):
        source = cache / "code" / "rebuilt.py"
        source.unlink(missing_ok=True)
        source.write_text("from mo_deepdrive.simulation.jit import jit\n@jit\ndef double(x):\n    return 2.0 * x\n")
        os.utime(source, (seconds, seconds))
        setting = f"import sys, numba\nnumba.config.CACHE_DIR = {str(cache)!r}\n"
        path = f"sys.path.insert(0, {str(source.parent)!r})\nfrom rebuilt import double\n"
        found.append(run_python(f"{setting}{path}print(double(2.0), sum(double.stats.cache_hits.values()))").split())
    assert found == [["4.0", "0"], ["4.0", "1"]]


CALLED = (
    "from mo_deepdrive.simulation.jit import separate_jit\n@separate_jit\ndef called(x):\n    return {factor} * x\n"
)
CALLER = (
    "from called import called\nfrom mo_deepdrive.simulation.jit import separate_jit\n"
    "@separate_jit\ndef caller(x):\n    return called(x)\nprint(caller(2.0))"
)


@pytest.mark.slow
def test_a_function_is_compiled_again_when_one_of_another_folder_that_it_calls_has_changed(
    cache: Path, run_python: Callable[[str], str]
) -> None:
    for name in ("one", "two"):
        (cache / name).mkdir()
    (cache / "two" / "caller.py").write_text(CALLER)
    setting = f"import sys, numba\nnumba.config.CACHE_DIR = {str(cache)!r}\n"
    paths = f"sys.path[:0] = [{str(cache / 'one')!r}, {str(cache / 'two')!r}]\nimport caller\n"
    found = []
    for factor in (3.0, 3.0, 5.0):
        (cache / "one" / "called.py").write_text(CALLED.format(factor=factor))
        found.append(run_python(f"{setting}{paths}print(sum(caller.caller.stats.cache_hits.values()))").split())
    assert found == [["6.0", "0"], ["6.0", "1"], ["10.0", "0"]]
