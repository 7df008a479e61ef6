"""The Slurm batch script of a sweep."""

from __future__ import annotations

import shlex
import subprocess
import sys

import pytest

from algorithms.studies.sweep_settings import load_sweep
from tests.helpers.sweep_files import write_sweep

pytest.importorskip("submitit", reason="submitit is not installed: pip install 'mo-deepdrive[sweep]'")


from pathlib import Path

from algorithms.studies.slurm_script import START, batch_script, sbatch_options


def test_a_task_requests_the_resources_of_all_its_concurrent_runs(tmp_path: Path) -> None:
    resources = {"cpus": 1.5, "gpus": 0.5, "memory_gb": 1.2, "minutes": 90}
    settings = load_sweep(
        write_sweep(tmp_path, resources=resources, slurm={"side_by_side": 3, "additional": {"nice": 1}})
    )
    wanted = sbatch_options(settings, "name")
    assert (wanted["cpus_per_task"], wanted["gpus_per_node"], wanted["mem"], wanted["time"]) == (5, 2, "3687MB", 90)
    assert wanted["additional_parameters"] == {"requeue": True, "nice": 1}
    assert "partition" not in wanted


def test_several_tasks_are_an_array_and_one_is_not(tmp_path: Path) -> None:
    settings = load_sweep(write_sweep(tmp_path))
    assert "#SBATCH --array=0-2%" in batch_script(3, settings, tmp_path)
    assert "#SBATCH --array=0-1%" in batch_script(2, settings, tmp_path)
    assert "--array" not in batch_script(1, settings, tmp_path)


def test_by_default_a_task_has_one_run_and_the_memory_that_slurm_chooses(tmp_path: Path) -> None:
    settings = load_sweep(write_sweep(tmp_path))
    assert (settings.slurm.runs_per_job, settings.slurm.side_by_side) == (1, 1)
    assert "mem" not in sbatch_options(settings, "name")


def test_a_task_imports_the_package_even_where_the_working_directory_has_one_of_its_name(tmp_path: Path) -> None:
    (tmp_path / "algorithms").mkdir()
    (tmp_path / "algorithms" / "__init__.py").write_text("raise SystemExit('the wrong package')")
    (tmp_path / "own.py").write_text("VALUE = 3")
    script = batch_script(1, load_sweep(write_sweep(tmp_path)), tmp_path / "sweep")
    *_, _, start, folder = shlex.split(script.splitlines()[-1])
    assert (start, folder) == (START, str(tmp_path / "sweep" / "slurm"))
    look = START.replace(
        "submitit_main()", "import algorithms, own; print(algorithms.ALGORITHMS['pcn'].name, own.VALUE)"
    )
    done = subprocess.run([sys.executable, "-c", look], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout == "pcn 3\n", done.stderr
