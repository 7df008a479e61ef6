"""The part of sweeps on Slurm that needs no Slurm; the rest is in tests/cluster."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.helpers.sweep_files import write_sweep

pytest.importorskip("submitit", reason="submitit is not installed: pip install 'mo-deepdrive[sweep]'")

import submitit

from algorithms.sweeps import slurm
from algorithms.sweeps.manifest import expand
from algorithms.sweeps.settings import load_sweep


def test_more_tasks_than_an_array_may_have_become_several_arrays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = load_sweep(write_sweep(tmp_path, seeds=7, slurm={"runs_per_job": 2}))
    jobs = [row.job(tmp_path) for row in expand(settings, {})]
    batches: list[list[slurm.Chunk]] = []

    class Executor(slurm._ScriptOnly):
        @contextlib.contextmanager
        def batch(self, allow_implicit_submissions: bool = False) -> Iterator[None]:
            batches.append([])
            yield

        def submit(self, fn: Any, *args: Any, **kwargs: Any) -> Any:
            batches[-1].append(fn)
            return SimpleNamespace(job_id=f"{len(batches)}_{len(batches[-1]) - 1}")

    monkeypatch.setattr(submitit, "SlurmExecutor", Executor)
    monkeypatch.setattr(slurm, "ARRAY", 3)
    tasks = slurm.chunks(jobs, settings, tmp_path)
    (tmp_path / "slurm").mkdir()
    slurm.Queue(tmp_path).submit(tasks, settings, tmp_path)
    assert [len(batch) for batch in batches] == [3, 3, 1]
    submitted = json.loads((tmp_path / "slurm" / "jobs.json").read_text())
    assert [run for runs in submitted.values() for run in runs] == [job.id for job in jobs]
    assert list(submitted) == ["1_0", "1_1", "1_2", "2_0", "2_1", "2_2", "3_0"]
    assert slurm.Queue(tmp_path).jobs == submitted


def test_a_task_gets_what_the_runs_that_it_makes_at_a_time_need(tmp_path: Path) -> None:
    resources = {"cpus": 1.5, "gpus": 0.5, "memory_gb": 1.2, "minutes": 90}
    settings = load_sweep(
        write_sweep(tmp_path, resources=resources, slurm={"side_by_side": 3, "additional": {"nice": 1}})
    )
    wanted = slurm.parameters(settings, "name")
    assert (wanted["cpus_per_task"], wanted["gpus_per_node"], wanted["mem"], wanted["time"]) == (5, 2, "3687MB", 90)
    assert wanted["additional_parameters"] == {"requeue": True, "nice": 1}
    assert "partition" not in wanted
