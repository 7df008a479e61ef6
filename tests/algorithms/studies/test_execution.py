"""The order in which a sweep's runs are made, and what is repeated, with runs that do not train."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from algorithms.studies.execution import Runner
from algorithms.studies.manifest import read_manifest
from algorithms.studies.plan import SweepPlan
from algorithms.studies.settings import load_sweep
from tests.helpers.made_up_sweeps import MadeUpBackend
from tests.helpers.sweep_files import write_sweep

RATE = "algorithm.learning_rate"
SEARCH = {"space": {RATE: {"low": 1e-4, "high": 1e-2}}, "metric": "stochastic/utility_esr", "trials": 6, "batch": 2}


class MadeUpRuns(Runner):
    """A runner whose runs end at once, with an error if their number is in ``failing``."""

    def __init__(self, directory: Path, file: Path, *failing: int, **backend: Any):
        self.said = io.StringIO()
        made_up = MadeUpBackend(**backend, fails=lambda job: ids(directory).index(str(job.id)) in failing)
        self.batches = made_up.batches
        super().__init__(SweepPlan(load_sweep(file)), directory, made_up, Console(file=self.said, width=200))


def ids(directory: Path) -> list[str]:
    return [row.id for row in read_manifest(directory)]


def test_a_failed_run_is_reported_and_repeated_by_the_next_command(tmp_path: Path) -> None:
    file, sweep = write_sweep(tmp_path, seeds=2), tmp_path / "sweep"
    runner = MadeUpRuns(sweep, file, 1)
    assert runner.run() == 1
    assert runner.batches == [ids(sweep)]
    assert "4 runs, 0 of them done" in runner.said.getvalue()
    assert "made to fail" in runner.said.getvalue()
    again = MadeUpRuns(sweep, file)
    assert again.run() == 0
    assert again.batches == [[ids(sweep)[1]]]
    assert "4 runs, 3 of them done" in again.said.getvalue()


def test_the_directory_of_another_sweep_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    assert MadeUpRuns(sweep, write_sweep(tmp_path, seeds=2)).run() == 0
    before = (sweep / "manifest.jsonl").read_bytes()
    other = write_sweep(tmp_path, overrides={"training.total_timesteps": 640})
    message = (
        r"sweep' has another sweep: none of its 4 runs, such as algorithm.learning_rate=0.001 seed 0 \([0-9a-f]+\), is "
        "in this one; choose another directory, or delete that sweep"
    )
    runner = MadeUpRuns(sweep, other)
    for start in (MadeUpRuns(sweep, other, name="manifest").run, runner.run, runner.remake, runner.print_batch_script):
        with pytest.raises(ValueError, match=message):
            start()
    assert runner.batches == []
    assert (sweep / "manifest.jsonl").read_bytes() == before


def test_a_sweep_is_extended_by_seeds_and_cells(tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    MadeUpRuns(sweep, write_sweep(tmp_path, seeds=1)).run()
    first = ids(sweep)
    extended = write_sweep(tmp_path, seeds=2, grid={"algorithm.learning_rate": [0.003, 0.01]})
    runner = MadeUpRuns(sweep, extended)
    assert runner.run() == 0
    assert len(runner.batches[0]) == 3
    assert set(first) & set(ids(sweep)) == {first[1]}
    assert "1 runs of the previous manifest are no longer in the sweep" in runner.said.getvalue()


def test_the_directory_of_a_run_is_refused(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").touch()
    with pytest.raises(ValueError, match="run' is the directory of a run; choose another directory"):
        MadeUpRuns(run, write_sweep(tmp_path)).run()
    assert [path.name for path in run.iterdir()] == ["config.yaml"]


def test_failed_points_of_a_search_are_repeated_only_while_no_later_points_depend_on_them(tmp_path: Path) -> None:
    pytest.importorskip("optuna")
    file, sweep = write_sweep(tmp_path, search=SEARCH), tmp_path / "sweep"
    runner = MadeUpRuns(sweep, file, 0, 3, 5)
    assert runner.run() == 1
    assert [len(batch) for batch in runner.batches] == [2, 2, 2]
    again = MadeUpRuns(sweep, file)
    assert again.run() == 1
    assert again.batches == [[ids(sweep)[5]]]
    assert again.said.getvalue().count("made to fail") == 2


def test_code_that_a_manifest_names_is_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("optuna")
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w').close()\n")
    monkeypatch.syspath_prepend(tmp_path)
    file = write_sweep(tmp_path, search=SEARCH)
    MadeUpRuns(tmp_path / "sweep", file).run()
    path = tmp_path / "sweep" / "manifest.jsonl"
    first, last = path.read_text().splitlines()[0], json.loads(path.read_text().splitlines()[-1])
    last["config"]["algorithm"]["name"] = "evil:Algorithm"
    path.write_text(f"{first}\n{json.dumps(last)}\n")
    status = {"state": "finished", "files": {"checkpoint.safetensors": {}}}
    (tmp_path / "sweep" / last["directory"] / "status.json").write_text(json.dumps(status))
    again = MadeUpRuns(tmp_path / "sweep", file)
    assert again.remake() == 0
    assert ids(tmp_path / "sweep")[-1] == last["id"]
    assert not (tmp_path / "imported").exists()
