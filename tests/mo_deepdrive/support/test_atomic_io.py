"""Files are replaced as a whole or not at all."""

from __future__ import annotations

import csv
import errno
import io
import os
from pathlib import Path
from typing import Any

import pytest

from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes, expand_home, lock, own_path, read_json_object

if os.name == "posix":
    import fcntl


def test_an_atomic_write_replaces_the_file_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")
    path.chmod(0o640)
    atomic_write(path, b"new")
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("of", "function"), [(os, "fsync"), (Path, "replace")])
def test_a_full_disk_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, of: Any, function: str
) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")

    def full(*arguments: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(of, function, full)
    with pytest.raises(OSError, match="No space left"):
        atomic_write(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("exists", [True, False])
def test_a_write_through_a_link_replaces_its_target(tmp_path: Path, exists: bool) -> None:
    (tmp_path / "elsewhere").mkdir()
    target, link = tmp_path / "elsewhere" / "target", tmp_path / "link"
    if exists:
        target.write_text("old")
        target.chmod(0o640)
    link.symlink_to(Path("elsewhere") / "target")
    atomic_write(link, b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"
    assert not exists or target.stat().st_mode & 0o777 == 0o640
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX permissions and locks")
@pytest.mark.parametrize("error", [PermissionError(), OSError(errno.ENOTSUP, "")], ids=repr)
def test_files_are_written_on_a_file_system_that_has_only_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: OSError
) -> None:
    def refuse(*_arguments: Any, **_options: Any) -> None:
        raise error

    for module, name in ((os, "chmod"), (os, "fchmod"), (os, "fsync"), (os, "utime"), (os, "link"), (fcntl, "flock")):
        monkeypatch.setattr(module, name, refuse)
    path = tmp_path / "file"
    for data in (b"old", b"new"):
        atomic_write(path, data)
    assert path.read_bytes() == b"new"
    if not isinstance(error, PermissionError):
        for wait in (False, True):
            lock(tmp_path / "lock", wait=wait).release()


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX permissions")
@pytest.mark.parametrize(("umask", "mode"), [(0o002, 0o664), (0o077, 0o600)])
def test_a_new_file_has_the_permissions_that_the_umask_leaves(tmp_path: Path, umask: int, mode: int) -> None:
    before = os.umask(umask)
    try:
        atomic_write(tmp_path / "file", b"new")
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == mode


def test_no_link_in_a_directory_is_followed_but_one_to_it_is(tmp_path: Path) -> None:
    (tmp_path / "run" / "inner").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "run")
    for name in ("new", "inner/new", "inner"):
        assert own_path(tmp_path / "link", name) == tmp_path / "link" / name
    (tmp_path / "run" / "out").symlink_to(tmp_path / "elsewhere")
    for name in ("out", "out/new"):
        with pytest.raises(ValueError, match=f"out.*leads to '{tmp_path}/elsewhere.*through a link inside a run or"):
            own_path(tmp_path / "run", name)


def test_a_tilde_is_the_home_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert [expand_home(path) for path in ("~", "~/a", "a/~", "b~")] == [
        tmp_path,
        tmp_path / "a",
        Path("a/~"),
        Path("b~"),
    ]
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # an account that has none
    with pytest.raises(ValueError, match=r"path '~/a': this user has no home directory, and HOME is not set"):
        expand_home("~/a")


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
        ("-cmd", "'-cmd"),
        ("@SUM(A1)", "'@SUM(A1)"),
        ("\t=1", "'\t=1"),
        ("-1.5e-3", "-1.5e-3"),
        (-3, "-3"),
        ("a=b", "a=b"),
    ],
)
def test_text_is_no_formula_in_a_spreadsheet_and_numbers_stay(cell: Any, text: str) -> None:
    ((header, found),) = csv.reader(io.StringIO(csv_bytes([["name", cell]]).decode(), newline=""))
    assert (header, found) == ("name", text)
