"""The reproduction from start to finish, with mo-deepdrive reproduce."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from algorithms.runs.jobs import Job
from algorithms.studies import paper_pipeline as pipeline
from algorithms.studies.paper_plan import load_plan, planned_runs
from algorithms.studies.paper_report import QUICK, verdict_table
from algorithms.studies.paper_results import ReproductionResults, gather
from tests.helpers.paths import REPOSITORY
from tests.helpers.reproduction import PLAN, TINY, make_results


@pytest.fixture
def call(
    load_script: Callable[[str], ModuleType],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Callable[..., Any]:
    (tmp_path / "plan.yaml").write_text(TINY)
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> tuple[int, str, str]:
        code = load_script("reproduce").main(
            ["--plan", "plan.yaml", *([] if "--redraw" in arguments else ["--workers", "2"]), *arguments]
        )
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.mark.processes
@pytest.mark.slow
def test_missing_runs_are_trained_and_a_second_call_trains_nothing(call: Callable[..., Any], tmp_path: Path) -> None:
    code, out, err = call("--claim", "1")
    assert (code, err) == (0, "")
    assert "6 runs, 0 of them done" in out
    results = tmp_path / "runs" / "reproduce" / "results"
    report = (results / "reproduction.md").read_text()
    assert "mo-deepdrive reproduce --claim 1" in report
    assert "no discount" in report
    assert "![Figure 4](figure_04.png)" in report
    assert (results / "figure_04.png").exists()
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("checkpoint.safetensors")}
    code, out, _ = call("--claim", "1")
    assert code == 0
    assert "of them done" not in out
    assert before == {path: path.stat().st_mtime_ns for path in before}
    found = ReproductionResults.read(results)
    runs = planned_runs(load_plan("plan.yaml").select(["one_waypoint_linear"]), tmp_path / "runs" / "reproduce")
    gathered = gather(runs, pytest.fail)
    assert [row["seed"] for row in found.scores] == [row["seed"] for row in gathered.scores]
    assert {row["policy"] for row in found.scores} == {"greedy", "stochastic"}
    paths = {(run.protocol, run.variant, run.seed): run.job.path for run in runs}
    for row in found.scores:
        path = paths[row["protocol"], row["variant"], row["seed"]]
        utility = json.loads((path / "evaluation.json").read_text())["policies"][row["policy"]]["utility_esr"]
        assert row["utility_esr_width"] == pytest.approx(utility["high"] - utility["low"], rel=1e-5)
    (results / "reproduction.md").unlink()
    code, _, _ = call("--claim", "1", "--redraw", "--output", str(results))
    assert code == 0
    assert verdict_table(load_plan("plan.yaml"), found) in (results / "reproduction.md").read_text()


def test_a_reproduction_of_everything_is_published_in_a_checkout_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = pipeline.ReproductionOptions(None, None, None, False, False, None, None, 1)
    assert options.output_folder == REPOSITORY / "docs" / "results"
    monkeypatch.setattr(pipeline, "PUBLISHED", tmp_path / "docs" / "results")
    assert options.output_folder == Path("runs/reproduce/results")


@pytest.mark.parametrize(
    ("arrivals", "solved"),
    [([0.0, 0.0, 0.99, 0.97, 0.0], 23), ([0.0, 0.0, 0.0, 0.0, 0.0], None), ([0.96, 0.97, 0.98, 0.99, 0.0], None)],
)
def test_a_success_is_exported_beside_a_median_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arrivals: list[float], solved: int | None
) -> None:
    plan = load_plan(PLAN)
    runs = [
        run
        for run in planned_runs(plan.select(["one_waypoint_linear"]), tmp_path)
        if (run.protocol, run.variant) == ("best", "mo_a2c")
    ]
    utilities = [10.0 * rate + 0.001 * i for i, rate in enumerate(arrivals)]
    scores = {"mo_a2c": {"utility_esr": utilities, "success": arrivals}}
    exported: dict[str, tuple[Path, dict[str, Any]]] = {}
    monkeypatch.setattr(Job, "open", lambda job: job.path)
    monkeypatch.setattr(pipeline, "export", lambda run, name, about: exported.update({name: (run, about)}))
    names = pipeline.export_policies(runs, plan, make_results("one_waypoint_linear", scores))
    assert names == list(exported) == ["one_waypoint_linear-mo_ppo", "one_waypoint_linear-mo_ppo-solved"][: len(names)]
    assert len(names) == (1 if solved is None else 2)
    path, about = exported["one_waypoint_linear-mo_ppo"]
    median = sorted(utilities)[2]
    assert f"-seed{20 + utilities.index(median)}-" in path.name
    assert about["chosen"] == "median utility_esr of 5 seeds"
    assert about["scores"]["stochastic"]["utility_esr"] == median
    if solved is not None:
        path, about = exported["one_waypoint_linear-mo_ppo-solved"]
        assert f"-seed{solved}-" in path.name
        assert about["chosen"] == "median utility_esr of the 2 of 5 seeds that arrive in over 95% of the episodes"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "0"], "--seeds 0 must be at least 1"),
        (["--redraw", "--quick"], "--redraw does not train"),
        (["--redraw", "--output", "nowhere"], "no results of a reproduction in 'nowhere'"),
        (["--plan", "other.yaml"], "config file 'other.yaml' does not exist"),
        (["--claim", "2"], "task 'one_waypoint_nonlinear' is unknown"),
    ],
)
def test_invalid_options_are_refused_before_anything_is_trained(
    call: Callable[..., Any], tmp_path: Path, arguments: list[str], message: str
) -> None:
    code, _, err = call(*arguments)
    assert code == 2
    assert message in err
    assert not (tmp_path / "runs").exists()


@pytest.mark.processes
@pytest.mark.slow
def test_a_quick_reproduction_judges_nothing_and_its_folder_takes_no_other(
    call: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("algorithms.studies.paper_plan.QUICK_STEPS", {"best": 400})
    code, out, _ = call("--quick", "--runs", "mine")
    assert code == 0
    assert "not judged" in out
    assert "**" not in out  # no verdict
    assert "It trains too little for verdicts." in out
    assert f"**{QUICK}**" in (tmp_path / "mine" / "results" / "reproduction.md").read_text()
    code, _, err = call("--runs", "mine", "--output", "out")
    assert code == 2
    assert "'mine' has another sweep: none of its 4 runs" in err
