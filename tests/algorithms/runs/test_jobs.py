"""Jobs: runs are made once, resumed where they were stopped, and never mixed up."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from algorithms.runs.config import make_experiment
from algorithms.runs.interrupts import DiskFull, JobFailed, Stopped
from algorithms.runs.jobs import Job, WorkerDied, differences, perform, perform_all, record, verdict
from algorithms.runs.progress import Dashboard
from algorithms.runs.run_directory import InUse, Run, read_status
from tests.helpers.short_runs import VALUES, job, quiet


@pytest.mark.slow
def test_a_job_is_trained_and_evaluated_once_without_figures(tmp_path: Path) -> None:
    wanted = job(tmp_path)
    assert not wanted.done
    assert perform(wanted) == "trained"
    assert wanted.done
    names = {path.name for path in wanted.path.iterdir()}
    assert {"evaluation.json", "metrics.csv", "checkpoint.safetensors", "train.log"} <= names
    assert not {"video.mp4", "curves.png"} & names
    before = {path: path.stat().st_mtime_ns for path in wanted.path.rglob("*") if path.is_file()}
    assert perform(wanted) == "already there"
    assert before == {path: path.stat().st_mtime_ns for path in wanted.path.rglob("*") if path.is_file()}


def test_a_directory_with_another_experiment_is_refused_before_anything_starts(tmp_path: Path) -> None:
    perform(job(tmp_path))
    other = Job("other", job(tmp_path, total_timesteps=961).experiment, tmp_path / "seed0")
    fresh = job(tmp_path, seed=1)
    with pytest.raises(ValueError, match=r"training.total_timesteps = 960 there, 961 wanted"):
        perform_all([fresh, other], 1, Dashboard([], quiet()))
    assert not fresh.path.exists()


def test_device_threads_and_logging_are_not_compared(tmp_path: Path) -> None:
    first, second = job(tmp_path, threads=1).experiment.to_dict(), job(tmp_path, threads=2).experiment.to_dict()
    second["logging"]["interval"] = 77
    assert differences(first, second) == []
    second["algorithm"]["gamma"] = 0.5
    assert differences(first, second) == ["algorithm.gamma = 0.99 there, 0.5 wanted"]


def with_device(wanted: Job, device: str) -> Job:
    """The same job on another device, which this machine need not have."""
    values = wanted.experiment.to_dict()
    values["training"]["device"] = device
    return replace(wanted, experiment=make_experiment(values, here=False))


def test_a_run_that_was_started_takes_over_device_and_logging_but_not_threads(tmp_path: Path) -> None:
    wanted = job(tmp_path, threads=1)
    Run.create(with_device(wanted, "cuda:99").experiment, wanted.path).unlock()
    changed = job(tmp_path, threads=2).experiment
    logging = changed.logging.model_copy(update={"checkpoint_interval": 77})
    changed = changed.model_copy(update={"logging": logging})
    assert perform(replace(wanted, experiment=changed), stop=lambda: True) == "stopped"
    experiment = Run.open(wanted.path).experiment
    assert (experiment.training.device, experiment.training.threads) == ("cpu", 1)
    assert experiment.logging.checkpoint_interval == 77
    before = (wanted.path / "config.yaml").stat()
    assert perform(replace(wanted, experiment=changed)) == "trained"
    assert (wanted.path / "config.yaml").stat() == before


def test_a_run_with_a_checkpoint_stays_on_its_kind_of_device(tmp_path: Path) -> None:
    wanted = job(tmp_path)
    assert perform(wanted, stop=lambda: True) == "stopped"
    assert perform(with_device(wanted, "cuda:99"), stop=lambda: True) == "stopped"
    assert Run.open(wanted.path).experiment.training.device == "cpu"
    config = wanted.path / "config.yaml"
    config.write_text(config.read_text().replace("device: cpu", "device: cuda:98"))
    with pytest.raises(ValueError, match=r"training\.device = 'cuda:98' does not exist"):
        perform(wanted)
    with pytest.raises(ValueError, match=r"training\.device = 'cuda:99' does not exist"):
        perform(with_device(wanted, "cuda:99"))


@pytest.mark.slow
def test_a_job_with_an_id_is_one_run_of_wandb_however_often_it_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    values = job(tmp_path).experiment.to_dict()
    values["logging"]["wandb"] = {"project": "sweeps"}
    wanted = Job("wanted", make_experiment(values), tmp_path / "run", id="0123456789ab")
    assert perform(wanted, stop=lambda: True) == "stopped"
    assert not wanted.done
    assert perform(wanted) == "trained"
    begun = [path.name for path in (wanted.path / "wandb").glob("offline-run-*")]
    assert len(begun) == 2
    # W&B numbers runs that begin within one second.
    assert all(re.fullmatch(r"offline-run-\d+_\d+-0123456789ab(-\d+)?", name) for name in begun), begun
    assert (wanted.path / "wandb_id").read_text() == "0123456789ab\n"


def test_what_a_killed_process_leaves_incomplete_is_made_again(tmp_path: Path) -> None:
    wanted = job(tmp_path)
    wanted.path.mkdir()
    for name in (".lock", ".config.yaml.abcdefgh.tmp", "versions.json", "status.json"):
        (wanted.path / name).write_text("{")
    assert perform(wanted) == "trained"
    assert not list(wanted.path.glob(".*.tmp"))
    (wanted.path / ".metrics.csv.abcdefgh.tmp").write_text("torn")
    Run.open(wanted.path).lock()
    assert not list(wanted.path.glob(".*.tmp"))


OWN_CODE = "def utility(returns):\n    return returns[..., 0]\n"


def test_a_job_may_import_what_its_own_experiment_names_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "jobs_code.py").write_text(OWN_CODE)
    (tmp_path / "other_code.py").write_text(OWN_CODE)
    monkeypatch.syspath_prepend(tmp_path)
    experiment = make_experiment({**VALUES, "utility": {"name": "jobs_code:utility"}})
    wanted = Job.unpack(Job("own", experiment, tmp_path / "own").packed())
    assert perform(wanted, stop=lambda: True) == "stopped"
    assert wanted.open().status["state"] == "interrupted"
    config = wanted.path / "config.yaml"
    text = config.read_text()
    config.write_text(text.replace("jobs_code:utility", "other_code:utility"))
    with pytest.raises(ValueError, match=r"holds another experiment: utility\.name = 'other_code:utility' there"):
        perform(wanted)
    assert "other_code" not in sys.modules
    config.write_text(text)
    assert perform(wanted) == "trained"


@pytest.mark.parametrize(
    ("error", "verdicts"),
    [
        (DiskFull("full"), ["stop", "stop", "stop"]),
        (InUse("held"), ["wait", "wait", "wait"]),
        (WorkerDied("killed"), ["retry", "retry", "fail"]),
        (Stopped("unwritable"), ["retry", "retry", "fail"]),
        (OSError("unreadable"), ["retry", "retry", "fail"]),
        (JobFailed("KeyError: 'x'"), ["fail", "fail", "fail"]),
        (ValueError("invalid"), ["fail", "fail", "fail"]),
    ],
)
def test_what_a_retry_may_mend_is_retried_as_often_as_allowed(error: Exception, verdicts: list[str]) -> None:
    assert [verdict(error, attempts, retries=2) for attempts in (1, 2, 3)] == verdicts


def test_a_death_is_written_to_the_status_of_the_run_which_could_not_do_so_itself(tmp_path: Path) -> None:
    job = Job("run", make_experiment(VALUES), tmp_path / "run")
    assert record(job, WorkerDied("killed")) == "killed"  # before the directory existed
    Run.create(job.experiment, job.path).unlock()
    assert record(job, WorkerDied("killed")) == "killed"
    status = read_status(job.path)
    assert (status["state"], status["reason"]) == ("failed", "killed")
