"""The Slurm backend, where it can be tested without Slurm; tests/cluster has the other tests."""

from __future__ import annotations

import contextlib
import json
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from tests.helpers.sweep_files import write_sweep

pytest.importorskip("submitit", reason="submitit is not installed: pip install 'mo-deepdrive[sweep]'")

import submitit

from algorithms.sweeps import slurm, slurm_script
from algorithms.sweeps.manifest import expand
from algorithms.sweeps.sweep_settings import load_sweep

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def test_tasks_beyond_the_maximum_size_of_an_array_go_to_further_arrays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = load_sweep(write_sweep(tmp_path, seeds=7, slurm={"runs_per_job": 2}))
    jobs = [row.job(tmp_path) for row in expand(settings, {})]
    batches: list[list[slurm.ArrayTask]] = []

    class Executor(slurm_script._ScriptWriter):
        @contextlib.contextmanager
        def batch(self, allow_implicit_submissions: bool = False) -> Iterator[None]:
            batches.append([])
            yield

        def submit(self, fn: Any, *args: Any, **kwargs: Any) -> Any:
            batches[-1].append(fn)
            return SimpleNamespace(job_id=f"{len(batches)}_{len(batches[-1]) - 1}")

    monkeypatch.setattr(submitit, "SlurmExecutor", Executor)
    monkeypatch.setattr(slurm, "MAX_ARRAY_TASKS", 3)
    tasks = slurm.array_tasks(jobs, settings, tmp_path)
    (tmp_path / "slurm").mkdir()
    slurm.SlurmQueue(tmp_path).submit(tasks, settings, tmp_path)
    assert [len(batch) for batch in batches] == [3, 3, 1]
    submitted = json.loads((tmp_path / "slurm" / "jobs.json").read_text())
    assert [run for runs in submitted.values() for run in runs] == [job.id for job in jobs]
    assert list(submitted) == ["1_0", "1_1", "1_2", "2_0", "2_1", "2_2", "3_0"]
    assert slurm.SlurmQueue(tmp_path).jobs == submitted
