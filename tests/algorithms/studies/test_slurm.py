"""The Slurm backend, where it can be tested without Slurm; tests/cluster has the other tests."""

from __future__ import annotations

import contextlib
import json
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from tests.helpers.short_runs import quiet
from tests.helpers.sweep_files import write_sweep

pytest.importorskip("submitit", reason="submitit is not installed: pip install --editable '.[sweep]'")


from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from algorithms.runs.jobs import Job
from algorithms.runs.progress import Dashboard
from algorithms.studies import slurm
from algorithms.studies.execution import Backend, Runner
from algorithms.studies.manifest import Scores, read_manifest
from algorithms.studies.plan import SweepPlan
from algorithms.studies.settings import SweepSettings, load_sweep


@dataclass
class FakeSlurm:
    """Slurm's queue: the tasks of every array, and what squeue prints; a job without a state is unknown."""

    sweep: Path
    arrays: list[list[slurm.ArrayTask]] = field(default_factory=list)
    states: dict[str, str] = field(default_factory=dict)
    after_submission: Callable[[list[str]], None] = lambda jobs: None
    commands: list[list[str]] = field(default_factory=list)

    def start(self, job: str) -> None:
        """Leave what Slurm leaves of a job that starts."""
        (self.sweep / "slurm" / f"{job}_0_log.out").touch()

    def run(self, command: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
        """The commands of Slurm."""
        self.commands += [list(command)]
        states = self.states if command[0] == "squeue" else {}
        return subprocess.CompletedProcess(command, 0, "".join(f"{job}|{state}\n" for job, state in states.items()))

    def calls(self, program: str) -> list[list[str]]:
        """The calls of a program."""
        return [command for command in self.commands if command[0] == program]


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeSlurm:
    """A fake Slurm, whose jobs end only if a test says so."""
    queue = FakeSlurm(tmp_path)

    class Executor(slurm.TaskExecutor):
        @contextlib.contextmanager
        def batch(self, allow_implicit_submissions: bool = False) -> Iterator[None]:
            queue.arrays.append([])
            yield
            queue.after_submission([f"{len(queue.arrays)}_{task}" for task in range(len(queue.arrays[-1]))])

        def submit(self, fn: Any, *args: Any, **kwargs: Any) -> Any:
            queue.arrays[-1].append(fn)
            return SimpleNamespace(job_id=f"{len(queue.arrays)}_{len(queue.arrays[-1]) - 1}")

    (tmp_path / "slurm").mkdir()
    monkeypatch.setattr(slurm, "TaskExecutor", Executor)
    monkeypatch.setattr(shutil, "which", lambda program: f"/usr/bin/{program}")
    monkeypatch.setattr(subprocess, "run", queue.run)
    monkeypatch.setattr(slurm, "POLL", 1e-3)
    monkeypatch.setattr(slurm.time, "sleep", lambda seconds: None)
    return queue


def jobs_of(settings: SweepSettings, sweep: Path) -> list[Job]:
    """The runs of a sweep."""
    return [row.job(sweep) for row in SweepPlan(settings).rows(Scores())]


def run_on_slurm(settings: SweepSettings, jobs: Sequence[Job], sweep: Path, **options: Any) -> dict[Job, str]:
    """Call the backend."""
    dashboard = Dashboard(jobs, quiet())
    return slurm.run_on_slurm(jobs, settings, sweep, dashboard, **{"stop": lambda: False, **options})


def test_tasks_beyond_the_maximum_size_of_an_array_go_to_further_arrays(
    tmp_path: Path, fake: FakeSlurm, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = load_sweep(write_sweep(tmp_path, seeds=7, slurm={"runs_per_job": 2}))
    jobs = jobs_of(settings, tmp_path)
    monkeypatch.setattr(slurm, "MAX_ARRAY_TASKS", 3)
    slurm.SlurmQueue(tmp_path).submit(jobs, settings)
    assert [len(array) for array in fake.arrays] == [3, 3, 1]
    submitted = json.loads((tmp_path / "slurm" / "jobs.json").read_text())
    assert [run for runs in submitted.values() for run in runs] == [job.id for job in jobs]
    assert list(submitted) == ["1_0", "1_1", "1_2", "2_0", "2_1", "2_2", "3_0"]
    assert slurm.SlurmQueue(tmp_path).jobs == submitted


# ----------------------------------------------------------------------------------------------------- the batch script


def test_a_task_requests_the_resources_of_all_its_concurrent_runs(tmp_path: Path) -> None:
    resources = {"cpus": 1.5, "gpus": 0.5, "memory_gb": 1.2, "minutes": 90}
    settings = load_sweep(
        write_sweep(tmp_path, resources=resources, slurm={"side_by_side": 3, "additional": {"nice": 1}})
    )
    wanted = slurm.sbatch_options(settings, "name")
    assert (wanted["cpus_per_task"], wanted["gpus_per_node"], wanted["mem"], wanted["time"]) == (5, 2, "3687MB", 90)
    assert wanted["additional_parameters"] == {"requeue": True, "nice": 1}
    assert "partition" not in wanted
    assert "mem" not in slurm.sbatch_options(load_sweep(write_sweep(tmp_path)), "name")


@pytest.mark.slow
def test_a_task_imports_the_package_even_where_the_working_directory_has_one_of_its_name(tmp_path: Path) -> None:
    (tmp_path / "algorithms").mkdir()
    (tmp_path / "algorithms" / "__init__.py").write_text("raise SystemExit('the wrong package')")
    (tmp_path / "own.py").write_text("VALUE = 3")
    script = slurm.batch_script(1, load_sweep(write_sweep(tmp_path)), tmp_path / "sweep")
    *_, _, start, folder = shlex.split(script.splitlines()[-1])
    assert (start, folder) == (slurm.START, str(tmp_path / "sweep" / "slurm"))
    look = slurm.START.replace(
        "submitit_main()", "import algorithms, own; print(algorithms.ALGORITHMS['pcn'].name, own.VALUE)"
    )
    done = subprocess.run([sys.executable, "-c", look], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout == "pcn 3\n", done.stderr


# ------------------------------------------------------------------------------------------------------ cancelled, lost


def test_an_array_task_that_is_cancelled_before_it_starts_is_not_submitted_again(
    tmp_path: Path, fake: FakeSlurm
) -> None:
    """Slurm forgets it at once."""
    settings = load_sweep(write_sweep(tmp_path))
    _, second = jobs = jobs_of(settings, tmp_path)

    def cancel_second(submitted: list[str]) -> None:
        fake.states = {"1_0": "RUNNING"}
        fake.start("1_0")

    fake.after_submission = cancel_second
    failed = run_on_slurm(settings, jobs, tmp_path, stop=lambda: len(fake.calls("squeue")) > 4)
    assert failed == {second: "Slurm job 1_1 ended (CANCELLED) before the run did"}
    assert len(fake.arrays) == 1


@pytest.mark.parametrize("state", ["NODE_FAIL", "gone"])
@pytest.mark.parametrize("retries", [0, 2])
def test_a_job_that_dies_is_submitted_again_as_often_as_allowed(
    tmp_path: Path, fake: FakeSlurm, state: str, retries: int
) -> None:
    settings = load_sweep(write_sweep(tmp_path, grid={}, retries=retries))
    (job,) = jobs_of(settings, tmp_path)

    def die(submitted: list[str]) -> None:
        fake.start(submitted[0])
        fake.states = {} if state == "gone" else {submitted[0]: state}

    fake.after_submission = die
    failed = run_on_slurm(settings, [job], tmp_path)
    assert len(fake.arrays) == 1 + retries
    last = f"{1 + retries}_0"
    shown = "LOST" if state == "gone" else state
    log = tmp_path / "slurm" / f"{last}_0_log.out"
    assert failed == {job: f"Slurm job {last} ended ({shown}) before the run did; see {log}"}


@pytest.mark.parametrize(
    ("states", "requeued"),
    [({"4_1": "RUNNING"}, True), ({"4_1": "CANCELLED"}, False), ({}, False)],
)
def test_a_task_that_was_stopped_requeues_itself_alone_unless_it_was_cancelled(
    tmp_path: Path, fake: FakeSlurm, monkeypatch: pytest.MonkeyPatch, states: dict[str, str], requeued: bool
) -> None:
    monkeypatch.setenv("SLURM_ARRAY_JOB_ID", "4")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "1")
    monkeypatch.setenv("SLURM_JOB_ID", "4")  # one task has the id of the array, by which Slurm would requeue all tasks
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "slurm")
    fake.states = states
    handlers: list[Callable[[int, None], None]] = []
    monkeypatch.setattr(slurm.signal, "signal", lambda number, handler: handlers.append(handler))

    def perform_all(*_: Any, stop: Callable[[], bool], **__: Any) -> dict[Job, str]:
        handlers[0](15, None)
        assert stop()
        return {}

    monkeypatch.setattr(slurm, "perform_all", perform_all)
    assert slurm.ArrayTask((), side_by_side=1, retries=0)() == []
    by_itself = [["scontrol", "requeue", "4_1"]]
    assert fake.calls("scontrol") == (by_itself if requeued else [])
    near_the_time_limit: list[list[str]] = []
    monkeypatch.setattr(subprocess, "check_call", lambda command, **_: near_the_time_limit.append(command))
    slurm.submitit.JobEnvironment()._requeue(1)
    assert near_the_time_limit == by_itself


# ------------------------------------------------------------------------------------------------------ without waiting


def fail(job: Job) -> None:
    """Leave what a run leaves that fails."""
    job.path.mkdir(parents=True, exist_ok=True)
    (job.path / "status.json").write_text('{"state": "failed", "reason": "made to fail"}')


def test_without_waiting_a_search_goes_on_without_runs_that_failed(tmp_path: Path, fake: FakeSlurm) -> None:
    pytest.importorskip("optuna")
    space = {"algorithm.learning_rate": {"low": 1e-4, "high": 1e-2}}
    search = {"space": space, "metric": "greedy/utility_esr", "trials": 4, "batch": 2}
    settings = load_sweep(write_sweep(tmp_path, search=search))
    fake.after_submission = lambda submitted: fake.states.update(dict.fromkeys(submitted, "RUNNING"))

    def submit() -> int:
        return Runner(SweepPlan(settings), tmp_path, Backend("slurm", wait=False), quiet()).run()

    assert submit() == 0
    first, second = (row.job(tmp_path) for row in read_manifest(tmp_path))
    fail(first)
    assert submit() == 0  # its job has not ended and may repeat it
    fake.states["1_0"] = "COMPLETED"
    assert submit() == 1
    assert len(fake.arrays) == 1  # the second run of the batch has not ended
    fail(second)
    fake.states["1_1"] = "COMPLETED"
    assert submit() == 1
    assert [[task.jobs[0].id for task in array] for array in fake.arrays] == [
        [first.id, second.id],
        [row.id for row in read_manifest(tmp_path)[2:]],
    ]


# ------------------------------------------------------------------------------------------------------------- messages


@pytest.mark.parametrize(
    ("states", "message"),
    [
        ({"1_0": "RUNNING", "1_1": "COMPLETED"}, "the jobs stay in Slurm's queue: the same command watches them again, "
         "`scancel 1` cancels them"),
        ({}, "no job is in Slurm's queue: the same command submits the runs that are not done"),
    ],
)  # fmt: skip
def test_after_an_interrupt_the_command_that_cancels_the_jobs_is_shown_if_there_are_any(
    tmp_path: Path, fake: FakeSlurm, states: dict[str, str], message: str
) -> None:
    settings = load_sweep(write_sweep(tmp_path))
    slurm.SlurmQueue(tmp_path).submit(jobs_of(settings, tmp_path), settings)
    fake.states = states
    assert slurm.after_interrupt(tmp_path) == message


def test_a_dry_run_prints_the_script_of_the_first_array_if_there_are_several_tasks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(slurm, "MAX_ARRAY_TASKS", 3)
    for seeds in (1, 4):
        settings = load_sweep(write_sweep(tmp_path, grid={}, seeds=seeds))
        assert Runner(SweepPlan(settings), tmp_path / "sweep", Backend("slurm"), quiet()).print_batch_script() == 0
        assert ("#SBATCH --array=0-2%3\n" in capsys.readouterr().out) == (seeds > 1)
