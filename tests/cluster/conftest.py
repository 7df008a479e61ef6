"""Fixtures of the tests of sweeps on clusters; all of these tests are marked ``cluster``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from filelock import FileLock

from tests.helpers.sweep_files import Reference, long_runs, run_sweep, write_sweep

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test in this folder."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.cluster)


@pytest.fixture(scope="session", autouse=True)
def ray_at_normal_priority() -> Iterator[None]:
    """Ray gives its workers a niceness of 15, with which they hardly run while other tests use all cores."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")
        yield


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """A temporary folder that is the same in all of pytest's workers."""
    folder = tmp_path_factory.getbasetemp()
    return folder if worker_id == "master" else folder.parent


@pytest.fixture(scope="session")
def short(shared_folder: Path) -> Reference:
    """A sweep of six runs of one second each."""
    settings = {"seeds": 3, "resources": {"cpus": 0.5}, "slurm": {"runs_per_job": 2}}
    return reference(shared_folder / "short", lambda folder: write_sweep(folder, **settings))


@pytest.fixture(scope="session")
def long(shared_folder: Path) -> Reference:
    """A sweep of two runs of some ten seconds each, to be interrupted."""
    return reference(shared_folder / "long", lambda folder: write_sweep(folder, overrides=long_runs(folder), seeds=1))


def reference(folder: Path, write: Callable[[Path], Path]) -> Reference:
    """The sweep that ``write`` describes in ``folder``; whoever comes first trains it, the others wait."""
    trained = Reference(folder / "short.yaml", folder / "here")
    with FileLock(folder.with_suffix(".lock")):
        if not folder.exists():
            folder.mkdir()
            assert write(folder) == trained.file
            assert run_sweep(trained.file, "--output", trained.directory).returncode == 0
    return trained
