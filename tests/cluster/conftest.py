"""Fixtures of the tests of sweeps on clusters; all of these tests are marked ``cluster``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.helpers.sweep_files import Reference, long_runs, run_sweep, write_sweep

if TYPE_CHECKING:
    from collections.abc import Iterator

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
def short(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """A sweep of six runs of one second each."""
    folder = tmp_path_factory.mktemp("short")
    reference = Reference(
        write_sweep(folder, seeds=3, resources={"cpus": 0.5}, slurm={"runs_per_job": 2}), folder / "here"
    )
    assert run_sweep(reference.file, "--output", reference.directory).returncode == 0
    return reference


@pytest.fixture(scope="session")
def long(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """A sweep of two runs of some ten seconds each, to be interrupted."""
    folder = tmp_path_factory.mktemp("long")
    reference = Reference(write_sweep(folder, overrides=long_runs(folder), seeds=1), folder / "here")
    assert run_sweep(reference.file, "--output", reference.directory).returncode == 0
    return reference
