"""What the tests of sweeps on clusters share."""

from __future__ import annotations

import pytest

from tests.helpers.sweep_files import LONG, Reference, run_sweep, write_sweep


@pytest.fixture(scope="session")
def short(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """Six runs of a second."""
    folder = tmp_path_factory.mktemp("short")
    reference = Reference(
        write_sweep(folder, seeds=3, resources={"cpus": 0.5}, slurm={"runs_per_job": 2}), folder / "here"
    )
    assert run_sweep(reference.file, "--output", reference.directory).returncode == 0
    return reference


@pytest.fixture(scope="session")
def long(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """Two runs of some seconds, to be interrupted."""
    folder = tmp_path_factory.mktemp("long")
    reference = Reference(write_sweep(folder, overrides=LONG, seeds=1), folder / "here")
    assert run_sweep(reference.file, "--output", reference.directory).returncode == 0
    return reference
