"""What the tests of sweeps on clusters share."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent.parent))  # short_runs, sweep_files

from sweep_files import LONG, run_sweep, write_sweep


@dataclass(frozen=True)
class Reference:
    """A sweep's file, and the directory of that sweep as this machine makes it without interruption."""

    file: Path
    directory: Path


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
