"""The Slurm batch script of a sweep."""

from __future__ import annotations

import pytest

from algorithms.sweeps.sweep_settings import load_sweep
from tests.helpers.sweep_files import write_sweep

pytest.importorskip("submitit", reason="submitit is not installed: pip install 'mo-deepdrive[sweep]'")

from typing import TYPE_CHECKING

from algorithms.sweeps.slurm_script import sbatch_options

if TYPE_CHECKING:
    from pathlib import Path


def test_a_task_requests_the_resources_of_all_its_concurrent_runs(tmp_path: Path) -> None:
    resources = {"cpus": 1.5, "gpus": 0.5, "memory_gb": 1.2, "minutes": 90}
    settings = load_sweep(
        write_sweep(tmp_path, resources=resources, slurm={"side_by_side": 3, "additional": {"nice": 1}})
    )
    wanted = sbatch_options(settings, "name")
    assert (wanted["cpus_per_task"], wanted["gpus_per_node"], wanted["mem"], wanted["time"]) == (5, 2, "3687MB", 90)
    assert wanted["additional_parameters"] == {"requeue": True, "nice": 1}
    assert "partition" not in wanted
