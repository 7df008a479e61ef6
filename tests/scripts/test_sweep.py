"""scripts/sweep.py on this machine: every run is trained once, and an interrupted sweep resumes to the same results."""

from __future__ import annotations

import math
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from algorithms.runs import jobs
from algorithms.runs.jobs import Job, perform
from algorithms.runs.progress import Dashboard
from tests.helpers.short_runs import job
from tests.helpers.sweep_files import (
    assert_same_sweep,
    enlarge_disk,
    eventually,
    forked_workers,
    interrupt,
    runs,
    small_disk,
    start_sweep,
    status,
    write_sweep,
)

Done = tuple[int, str, str]  # exit code, standard output, standard error
Call = Callable[..., Done]

RATE = "algorithm.learning_rate"
TWO_SECONDS = {"training.total_timesteps": 200_000, "training.num_envs": 64}  # per run, after compilation
PAGE = 4096

pytestmark = [pytest.mark.processes, pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="signals")]


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType], tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    """The script, with forked workers: this process has compiled everything, so they start at once."""
    perform(job(tmp_path_factory.mktemp("warm")))
    with forked_workers():
        yield load_script("sweep")


@pytest.fixture
def call(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Call:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    def call(file: Path, *options: str | Path) -> Done:
        capfd.readouterr()
        code = script.main(["--config", str(file), *map(str, options)])
        said = capfd.readouterr()
        print(said.out, said.err)
        return code, said.out, said.err

    return call


@pytest.fixture(scope="module")
def whole(script: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of two learning rates and two seeds, trained without interruption."""
    folder = tmp_path_factory.mktemp("whole")
    assert script.main(["--config", str(write_sweep(folder, seeds=2)), "--output", str(folder / "whole")]) == 0
    return folder / "whole"


def times(sweep: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in (sweep / "runs").rglob("*") if path.is_file()}


def states(sweep: Path) -> list[str | None]:
    return [status(run).get("state") for run in runs(sweep)]


# ---------------------------------------------------------------------------------------------------- complete and add


def test_a_finished_sweep_is_left_alone_and_new_runs_are_added(call: Call, tmp_path: Path, whole: Path) -> None:
    sweep = tmp_path / "sweep"
    file = write_sweep(tmp_path, seeds=2)
    code, out, _ = call(file, "--on", "manifest", "--output", sweep)
    assert (code, out) == (0, f"{sweep / 'manifest.jsonl'}: 4 runs\n")
    assert [path.name for path in sweep.iterdir()] == ["manifest.jsonl"]
    progress = call(file, "--status", "--output", sweep)
    assert progress == (0, "0 done, 0 running, 0 failed, 4 waiting of 4\n", "")

    code, out, error = call(file, "--output", sweep, "--workers", "2")
    assert (code, error) == (0, "")
    assert out.startswith(f"4 runs, 0 of them done, in {sweep}\n")
    assert out.endswith("4 done, 0 running, 0 failed, 0 waiting of 4\n")
    assert_same_sweep(sweep, whole)

    before, manifest = times(sweep), (sweep / "manifest.jsonl").read_bytes()
    code, out, _ = call(file, "--output", sweep)
    assert (code, out) == (0, "4 done, 0 running, 0 failed, 0 waiting of 4\n")
    assert (times(sweep), (sweep / "manifest.jsonl").read_bytes()) == (before, manifest)

    code, out, _ = call(write_sweep(tmp_path, seeds=3), "--output", sweep)
    assert code == 0
    assert out.startswith(f"6 runs, 4 of them done, in {sweep}\n")
    after = times(sweep)
    assert {path: after[path] for path in before} == before
    assert {path.relative_to(sweep / "runs").parts[0] for path in after.keys() - before.keys()} == {
        run.name for run in runs(sweep) if "-seed2-" in run.name
    }
    assert states(sweep) == ["finished"] * 6


# -------------------------------------------------------------------------------------------------------------- refused


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--workers", "0"], "--workers 0 must be at least 1"),
        (["--address", "auto"], "--address is for --on ray, not local"),
        (["--remake", "--on", "manifest"], "--remake is for --on local and ray and slurm, not manifest"),
        (["--status"], "is neither a sweep nor a study: it has no manifest.jsonl"),
        (["--output", "base.yaml"], "--output 'base.yaml'"),
    ],
)
def test_an_option_that_does_not_fit_is_refused(call: Call, tmp_path: Path, options: list[str], message: str) -> None:
    code, out, error = call(write_sweep(tmp_path), *options)
    assert (code, out) == (2, "")
    assert error.startswith("error: ")
    assert message in error
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("options", [["--status"], ["--output", "sweep", "--remake"]])
def test_a_sweep_needs_its_file_for_all_else(
    script: ModuleType, capfd: pytest.CaptureFixture[str], options: list[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        script.main(options)
    assert ended.value.code == 2
    assert "--config is required, except for --status and --verify with --output" in capfd.readouterr().err


@pytest.mark.parametrize(("backend", "module"), [("ray", "ray"), ("slurm", "submitit")])
def test_a_backend_that_is_not_installed_is_refused_with_what_to_install(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, backend: str, module: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    code, out, error = call(write_sweep(tmp_path), "--on", backend)
    assert (code, out) == (2, "")
    assert f"--on {backend} needs {module}: pip install --editable '.[sweep]'" in error
    assert not (tmp_path / "runs").exists()


def test_an_invalid_sweep_is_refused_before_anything_is_written(call: Call, tmp_path: Path) -> None:
    file = write_sweep(tmp_path, grid={"algorithm.learning_rat": [0.1]})
    code, out, error = call(file, "--output", "sweep")
    assert (code, out) == (2, "")
    assert "did you mean 'learning_rate'?" in error
    assert "Traceback" not in error
    assert {path.name for path in tmp_path.iterdir()} == {"base.yaml", "short.yaml"}


# --------------------------------------------------------------------------------------------------------------- verify


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def cut(path: Path, size: int) -> None:
    path.write_bytes(path.read_bytes()[:size])


DAMAGES: dict[str, Callable[[Path], None]] = {
    "checkpoint.safetensors: missing": lambda run: (run / "checkpoint.safetensors").unlink(),
    "metrics.csv: changed since the run finished": lambda run: cut(run / "metrics.csv", 100),
    "config.yaml: changed since the run finished": lambda run: edit(run / "config.yaml", "gamma: 0.99", "gamma: 0.98"),
    "evaluation.json: missing": lambda run: (run / "evaluation.json").unlink(),
}


def test_broken_runs_are_named_and_made_again(call: Call, tmp_path: Path, whole: Path) -> None:
    file = write_sweep(tmp_path, seeds=2)
    sweep = tmp_path / "sweep"
    shutil.copytree(whole, sweep)
    before = times(sweep)
    assert call(file, "--output", sweep, "--verify")[:2] == (0, "4 finished runs: 0 broken\n")
    for run, damage in zip(runs(sweep), DAMAGES.values(), strict=True):
        damage(run)
    before = times(sweep)
    code, out, _ = call(file, "--output", sweep, "--verify")
    assert code == 1
    lines = out.splitlines()
    for run, line, problem in zip(runs(sweep), lines, DAMAGES, strict=False):
        assert line.startswith(f"{run}: {problem}")
    assert lines[4:] == ["4 finished runs: 4 broken"]
    assert times(sweep) == before
    # The last one is evaluated again, the others are trained again.
    made = (runs(sweep)[3] / "versions.json").stat().st_mtime_ns
    assert call(file, "--output", sweep, "--remake")[0] == 0
    assert_same_sweep(sweep, whole)
    assert (runs(sweep)[3] / "versions.json").stat().st_mtime_ns == made


# ---------------------------------------------------------------------------------------------------------- interrupted


def begun(run: Path) -> bool:
    """Whether a run is in progress and has a checkpoint."""
    return status(run).get("state") == "running" and status(run)["step"] > 0


def test_a_sweep_that_was_interrupted_by_signals_resumes_to_the_same_results(call: Call, tmp_path: Path) -> None:
    file = write_sweep(tmp_path, overrides=TWO_SECONDS)
    sweep = tmp_path / "sweep"
    options = ("--output", sweep, "--workers", "1")
    with start_sweep(file, *options) as process:
        eventually(lambda: (sweep / "manifest.jsonl").exists() and begun(runs(sweep)[0]))
        os.killpg(process.pid, signal.SIGINT)  # like Ctrl-C: to all processes of the command
        out, _ = process.communicate(timeout=60)
    assert process.returncode == 130, out
    assert states(sweep) == ["interrupted", None]
    assert "interrupted; the runs in progress are saved: the same command resumes them" in out
    assert "Traceback" not in out
    with start_sweep(file, *options) as process:
        eventually(lambda: begun(runs(sweep)[1]))
        code, out = interrupt(process, signal.SIGTERM)
    assert code == 143
    assert states(sweep) == ["finished", "interrupted"]
    assert "the same command resumes" in out
    assert "Traceback" not in out
    assert call(file, *options)[0] == 0
    assert call(file, "--output", "whole")[0] == 0
    assert_same_sweep(sweep, tmp_path / "whole")


# --------------------------------------------------------------------------------------------------------------- search


def test_a_search_proceeds_batch_by_batch_and_resumes_to_the_same_results(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    space = {RATE: {"low": 1e-4, "high": 1e-1, "log": True}, "algorithm.steps": {"low": 4, "high": 16}}
    metric = "stochastic/return/distance"
    file = write_sweep(tmp_path, search={"space": space, "metric": metric, "trials": 6, "batch": 3})
    code, out, _ = call(file, "--output", "first", "--workers", "1")
    assert code == 0
    assert [line for line in out.splitlines() if line.endswith("in first")] == [
        "3 runs, 0 of them done, in first",
        "6 runs, 3 of them done, in first",
    ]
    first = tmp_path / "first"
    made = runs(first)
    assert len(made) == 6
    ended = max((run / "status.json").stat().st_mtime_ns for run in made[:3])
    assert all((run / "config.yaml").stat().st_mtime_ns > ended for run in made[3:])

    perform_all = jobs.perform_all

    def interrupted(jobs: Sequence[Job], workers: int, monitor: Dashboard, **options: Any) -> dict[Job, str]:
        def stop() -> bool:
            if not sent and len(jobs) == 6 and sum(each.done for each in jobs) >= 4:
                sent.append(signal.SIGINT)
                os.kill(os.getpid(), signal.SIGINT)
            return bool(given())

        sent: list[int] = []
        given = options.pop("stop")
        return perform_all(jobs, workers, monitor, stop=stop, **options)

    with monkeypatch.context() as patch:
        patch.setattr(jobs, "perform_all", interrupted)
        assert call(file, "--output", "second", "--workers", "2")[0] == 130
    assert states(tmp_path / "second").count("finished") < 6
    assert call(file, "--output", "second", "--workers", "2")[0] == 0
    assert_same_sweep(first, tmp_path / "second")


# ------------------------------------------------------------------------------------------------------------ full disk


def pages(path: Path) -> int:
    """Memory pages that a file, or all files in a folder, occupy."""
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    return sum(math.ceil(each.stat().st_size / PAGE) for each in files)


def test_a_full_disk_stops_the_sweep_with_one_message_and_with_more_space_it_resumes(
    call: Call, tmp_path: Path, whole: Path
) -> None:
    half = pages(whole / "runs") // 2
    file = write_sweep(tmp_path, seeds=2)
    disk = tmp_path / "disk"
    sweep = disk / "sweep"
    with small_disk(disk, (pages(whole / "manifest.jsonl") + half) * PAGE // 1024):
        code, out, error = call(file, "--output", sweep, "--workers", "1")
        found = states(sweep)
        enlarge_disk(disk, 20_000)
        assert call(file, "--output", sweep)[0] == 0
        assert_same_sweep(sweep, whole)
    assert code == 1
    assert error.count("error: ") == 1
    assert "No space left on device" in error
    assert "Traceback" not in error
    assert "FAILED" not in out
    assert "finished" in found
    assert None in found  # no other run is started
