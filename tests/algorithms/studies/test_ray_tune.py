"""The Ray Tune backend, where it can be tested without Ray's processes; tests/cluster has the other tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from algorithms.runs.config import make_experiment
from algorithms.runs.jobs import Job
from algorithms.runs.progress import Dashboard
from algorithms.runs.run_directory import Run, read_status
from algorithms.studies.settings import load_sweep
from tests.helpers.short_runs import VALUES, quiet
from tests.helpers.sweep_files import write_sweep

pytest.importorskip("ray.tune", reason="Ray is not installed: pip install --editable '.[sweep]'")


def test_a_run_on_a_device_that_the_driver_does_not_have_is_pruned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from algorithms.studies import ray_tune

    asha = {"metric": "greedy/utility_esr", "grace_period": 1}
    settings = load_sweep(write_sweep(tmp_path, ray={"asha": asha}))
    training = {**VALUES["training"], "device": "cuda:99"}
    job = Job("run", make_experiment({**VALUES, "training": training}, here=False), tmp_path / "run", "id")
    Run.create(job.experiment, job.path).unlock()

    class Tuner:
        def __init__(self, *_: Any, tune_config: Any, **__: Any):
            self.fit = lambda: tune_config.scheduler.pruned.add(job.id)

    monkeypatch.setattr(ray_tune.tune, "Tuner", Tuner)
    monkeypatch.setattr(ray_tune, "_connect", lambda address, sweep: None)
    dashboard = Dashboard([job], quiet())
    assert ray_tune.run_on_ray([job], settings, tmp_path, dashboard, stop=lambda: False) == {}
    assert read_status(job.path)["state"] == "pruned"
