"""Files are replaced as a whole or not at all."""

from __future__ import annotations

import csv
import errno
import io
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from mo_deepdrive.atomic_io import atomic_write, csv_bytes, open_lock, read_json_object

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


def test_an_atomic_write_replaces_the_file_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")
    path.chmod(0o640)
    atomic_write(path, b"new")
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [path]


def test_pieces_are_written_one_after_the_other(tmp_path: Path) -> None:
    path = tmp_path / "file"
    atomic_write(path, (f"line {i}\n".encode() for i in range(3)))
    assert path.read_text() == "line 0\nline 1\nline 2\n"


def test_pieces_that_fail_leave_the_old_file(tmp_path: Path) -> None:
    def pieces() -> Iterator[bytes]:
        yield b"new"
        raise ValueError("no second piece")

    path = tmp_path / "file"
    atomic_write(path, b"old")
    with pytest.raises(ValueError, match="no second piece"):
        atomic_write(path, pieces())
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("function", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, function: str) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")

    def full(*arguments: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, function, full)
    with pytest.raises(OSError, match="No space left"):
        atomic_write(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(sys.platform == "win32", reason="needs file size limits")
def test_a_file_size_limit_leaves_the_old_file(tmp_path: Path, run_python: Callable[[str], str]) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")
    said = run_python(
        "import resource\n"
        "from mo_deepdrive.atomic_io import atomic_write\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try:\n"
        f"    atomic_write({str(path)!r}, b'x' * 100_000)\n"
        "except OSError as error:\n"
        "    print(error.strerror)\n"
    )
    assert said == "File too large\n"
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_replaces_a_link_and_not_its_target(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("mine")
    link.symlink_to(target)
    atomic_write(link, b"new")
    assert target.read_text() == "mine"
    assert not link.is_symlink()
    assert link.read_bytes() == b"new"


def test_a_lock_is_created_and_its_content_is_kept(tmp_path: Path) -> None:
    lock = tmp_path / ".lock"
    open_lock(lock).close()
    lock.write_text("mine")
    open_lock(lock).close()
    assert lock.read_text() == "mine"


@pytest.mark.skipif(os.name != "posix", reason="runs are locked on POSIX systems")
@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo, lambda path: path.symlink_to("target")])
def test_a_lock_that_is_no_file_is_refused(tmp_path: Path, make: Callable[[Path], None]) -> None:
    (tmp_path / "target").write_text("mine")
    lock = tmp_path / ".lock"
    make(lock)
    with pytest.raises(ValueError, match=r"lock '.*\.lock' is not a regular file; delete it"):
        open_lock(lock)
    assert (tmp_path / "target").read_text() == "mine"


@pytest.mark.parametrize("content", [None, b"", b"[]", b"3", b'{"a"', b"\xff", b"[" * 100_000])
def test_files_without_a_json_object_are_empty(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "file.json"
    if content is not None:
        path.write_bytes(content)
    assert read_json_object(path) == {}
    path.write_bytes(b'{"a": [1]}')
    assert read_json_object(path) == {"a": [1]}


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        ("=1+1", "'=1+1"),
        ("+cmd", "'+cmd"),
        ("-cmd", "'-cmd"),
        ("@SUM(A1)", "'@SUM(A1)"),
        ("\t=1", "'\t=1"),
        ("-1_0", "'-1_0"),
        ("-1.5e-3", "-1.5e-3"),
        ("+2", "+2"),
        ("-inf", "-inf"),
        (-3, "-3"),
        ("a=b", "a=b"),
    ],
)
def test_text_is_no_formula_in_a_spreadsheet_and_numbers_stay(cell: Any, text: str) -> None:
    ((header, found),) = csv.reader(io.StringIO(csv_bytes([["name", cell]]).decode(), newline=""))
    assert (header, found) == ("name", text)
