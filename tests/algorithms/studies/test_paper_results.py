"""The tables of scores and learning curves."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import pytest

from algorithms.runs.run_directory import Run
from algorithms.studies import FIGURES
from algorithms.studies.paper_plan import load_plan, planned_runs
from algorithms.studies.paper_results import ReproductionResults, gather
from tests.helpers.paths import REPOSITORY
from tests.helpers.reproduction import PLAN, PUBLISHED, SOLVED, TINY, evenly_spread, make_results


def test_results_are_read_as_they_were_written_and_equal_results_give_equal_bytes(tmp_path: Path) -> None:
    results = make_results(
        "one_waypoint_linear", {"a2c": SOLVED, "mo_a2c": {**SOLVED, "extra": evenly_spread(1.0 / 3.0)}}
    )
    results.write(tmp_path)
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    again = ReproductionResults.read(tmp_path)
    assert len(again.scores) == len(results.scores)
    for mine, other in ((results.scores, again.scores), (results.curves, again.curves)):
        for row, found in zip(mine, other, strict=True):
            assert row.keys() == found.keys()
            for name, value in row.items():
                assert (
                    found[name] == pytest.approx(value, rel=1e-6) if isinstance(value, float) else found[name] == value
                )
    again.write(tmp_path)
    assert files == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert gzip.decompress(files["reproduction_curves.csv.gz"]).startswith(
        b"task,protocol,variant,label,seed,steps,step,"
    )


@pytest.mark.parametrize("damage", ["missing", "not gzip", "truncated"])
def test_broken_results_are_refused(tmp_path: Path, damage: str) -> None:
    with pytest.raises(ValueError, match="no results of a reproduction"):
        ReproductionResults.read(tmp_path)
    make_results("one_waypoint_linear", {"a2c": SOLVED}).write(tmp_path)
    curves = tmp_path / "reproduction_curves.csv.gz"
    data = curves.read_bytes()
    curves.unlink() if damage == "missing" else curves.write_bytes(b"x" if damage == "not gzip" else data[:-20])
    with pytest.raises(ValueError, match="no results of a reproduction"):
        ReproductionResults.read(tmp_path)


def test_the_published_scores_cover_the_whole_plan(tmp_path: Path) -> None:
    plan, results = load_plan(PLAN), ReproductionResults.read(PUBLISHED)
    wanted = {(r.task, r.protocol, r.variant, r.seed) for r in planned_runs(plan.select(list(plan.tasks)), tmp_path)}
    assert {(row["task"], row["protocol"], row["variant"], row["seed"]) for row in results.scores} == wanted
    assert {(row["task"], row["protocol"], row["variant"], row["seed"]) for row in results.curves} == wanted
    for figure in FIGURES:
        assert list(PUBLISHED.glob(f"figure_{figure:02}*.png"))


def test_runs_that_cannot_be_read_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "plan.yaml").write_text(TINY)
    monkeypatch.chdir(REPOSITORY)
    planned = planned_runs(load_plan(tmp_path / "plan.yaml").select(["one_waypoint_linear"]), tmp_path)
    for run in planned:
        opened = Run.create(run.job.experiment, run.job.path)
        scores = {"utility_esr": {"value": 1.0, "low": 0.5, "high": 2.0}}
        content = {"episodes": 4, "seed": 0, "policies": {"greedy": scores}}
        (run.job.path / "evaluation.json").write_text(json.dumps(content))
        (run.job.path / "metrics.csv").write_text("step,eval/greedy/utility_esr\n0,1.0\n")
        opened.set_status("finished", 1)
        opened.unlock()
    for run, name in zip(planned, ("evaluation.json", "metrics.csv"), strict=False):
        (run.job.path / name).write_bytes(b"\n\0")
    lines: list[str] = []
    results = gather(planned, lines.append)
    assert [(row["variant"], row["seed"]) for row in results.scores] == [(run.variant, run.seed) for run in planned[2:]]
    assert len(results.curves) == len(results.scores) == len(planned) - 2
    assert results.scores[0]["utility_esr_width"] == 1.5
    for line, run, name in zip(lines, planned, ("evaluation.json", "metrics.csv"), strict=False):
        assert line.startswith("left out: ")
        assert str(run.job.path / name) in line
