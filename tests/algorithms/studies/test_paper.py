"""The reproduction: what is trained, the report, and what is exported to the zoo."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from algorithms.commands.reproduce import main
from algorithms.runs.jobs import Job
from algorithms.studies import FIGURES, paper_report
from algorithms.studies.manifest import ManifestRow
from algorithms.studies.paper import CLAIMS, QUICK_SEEDS, PaperResults, load_paper, paper_plan
from algorithms.studies.paper_report import (
    QUICK,
    print_verdicts,
    verdict_table,
    write_report,
)
from algorithms.studies.plan import StudyPlan
from tests.helpers.paths import REPOSITORY
from tests.helpers.reproduction import PUBLISHED, SOLVED, TINY, evenly_spread, make_results, paper

TASKS = list(dict.fromkeys(key.partition("/")[0] for key in paper().tasks))


def final_rows(plan: StudyPlan) -> list[ManifestRow]:
    return [row for arm in plan.runs() if arm.arm.key in plan.selected for row in arm.final]


@pytest.fixture(scope="module")
def whole() -> list[ManifestRow]:
    """All runs of the study."""
    return final_rows(paper_plan(paper(), TASKS))


def arm_of(row: ManifestRow) -> tuple[str, str]:
    return row.cell["task"], row.cell["learner"]


# -------------------------------------------------------------------------------------------------------------- plan


@pytest.mark.slow
def test_every_run_of_the_study_is_scored_on_the_test_split_with_a_seed_of_no_other_table(
    whole: list[ManifestRow],
) -> None:
    assert len({row.directory for row in whole}) == len(whole) > 100
    seeds = {row.seed for row in whole}
    assert min(seeds) == 20
    assert not seeds & {*range(5), *range(100, 210)}  # of other tables, and of tuning
    assert {row.config["evaluation"]["split"] for row in whole} == {"test"}


def test_both_algorithms_of_a_protocol_have_the_same_budget_networks_and_environment(
    whole: list[ManifestRow],
) -> None:
    compared = [key for key in paper().tasks if paper().learners_of(key).keys() == {"a2c", "mo_a2c"}]
    # Six tasks as printed and with best effort, two of them also with both vehicles ending together, one continuous.
    assert len(compared) == 2 * 6 + 2 + 1
    for key in compared:
        first, second = ([row.config for row in whole if arm_of(row) == (key, name)] for name in ("a2c", "mo_a2c"))
        for one, other in zip(first, second, strict=True):
            assert one["training"] == other["training"]
            assert one["environment"] == other["environment"]
            for name in ("steps", "learning_rate", "epochs", "minibatches"):
                assert one["algorithm"].get(name) == other["algorithm"].get(name), (key, name)


@pytest.mark.slow
def test_a_quick_reproduction_differs_only_in_length_and_seeds(whole: list[ManifestRow]) -> None:
    quick = final_rows(paper_plan(paper(), TASKS, quick=True))
    configs = {arm_of(row): row.config for row in whole}
    seeds: dict[tuple[str, str], set[int]] = {}
    for row in quick:
        seeds.setdefault(arm_of(row), set()).add(row.seed)
        other = configs[arm_of(row)]
        assert row.config["training"]["total_timesteps"] < other["training"]["total_timesteps"]
        assert row.config["algorithm"] == other["algorithm"]
        assert row.config["evaluation"]["final_episodes"] == 200 < other["evaluation"]["final_episodes"]
        assert row.config["evaluation"]["interval"] * 5 == row.config["training"]["total_timesteps"]
    assert {len(numbers) for numbers in seeds.values()} == {QUICK_SEEDS}
    assert {task for task, _ in seeds} >= {f"{task}/best" for claim in CLAIMS for task in claim.tasks}


def test_fewer_seeds_are_the_first_ones_and_no_task_gets_more_than_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(REPOSITORY)
    (tmp_path / "plan.yaml").write_text(TINY)
    for count, seeds in ((1, {3}), (4, {3, 4, 5, 6})):
        rows = final_rows(paper_plan(load_paper(tmp_path / "plan.yaml"), ["one_waypoint_linear"], seeds=count))
        assert {row.seed for row in rows if row.cell["task"].endswith("best")} == seeds
        assert {row.seed for row in rows if row.cell["task"].endswith("ablation")} == {3}


# ------------------------------------------------------------------------------------------------------- the command


@pytest.fixture
def call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plan.yaml").write_text(TINY.replace("configs/", f"{REPOSITORY}/configs/"))

    def run(*arguments: str) -> tuple[int, str, str]:
        workers = [] if "--redraw" in arguments else ["--workers", "2"]
        try:
            code = main(["--plan", "plan.yaml", *workers, *arguments])
        except SystemExit as end:
            code = int(end.code or 0)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.mark.processes
@pytest.mark.slow
def test_missing_runs_are_trained_and_a_second_call_trains_nothing(call: Callable[..., Any], tmp_path: Path) -> None:
    code, out, err = call("--all", "--output", "out")
    assert (code, err) == (0, "")
    assert "8 runs, 0 of them done" in out
    results = tmp_path / "out"
    report = (results / "reproduction.md").read_text()
    assert all(text in report for text in ("mo-deepdrive reproduce --all", "no discount", "non-dominated policies |"))
    for picture in ("figure_04.png", "figure_07_best.png"):
        assert f"]({picture})" in report
        assert (results / picture).exists()
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("checkpoint.safetensors")}
    code, out, _ = call("--claim", "1", "--output", "out")
    assert code == 0
    assert "of them done" not in out
    assert before == {path: path.stat().st_mtime_ns for path in before}
    published = PaperResults.read(load_paper("plan.yaml"), results)
    rows = final_rows(paper_plan(published.study, ["one_waypoint_linear"]))
    assert {(row.task, row.learner, row.seed, row.policy) for row in published.rows} == {
        (*arm_of(row), row.seed, policy) for row in rows for policy in ("greedy", "stochastic")
    }
    curves = published.tasks["one_waypoint_linear"]["best"].learning_curves("a2c")
    assert [curve["step"][-1] for curve in curves] == [800, 800]
    (results / "reproduction.md").unlink()
    code, _, _ = call("--claim", "1", "--redraw", "--output", "out")
    assert code == 0
    assert verdict_table(published) in (results / "reproduction.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "0"], "--seeds 0 must be at least 1"),
        (["--redraw", "--quick"], "--redraw does not train"),
        (["--redraw", "--output", "nowhere"], "no results of a reproduction in 'nowhere'"),
        (["--plan", "other.yaml"], "config file 'other.yaml' does not exist"),
        (["--claim", "2"], "task 'one_waypoint_nonlinear' is unknown"),
        (["--plan", "untitled.yaml"], "task 'one_waypoint_linear/ablation' must be named TASK/PROTOCOL, with a title"),
    ],
)
def test_invalid_options_are_refused_before_anything_is_trained(
    call: Callable[..., Any], tmp_path: Path, arguments: list[str], message: str
) -> None:
    (tmp_path / "untitled.yaml").write_text((tmp_path / "plan.yaml").read_text().replace(": one change", ", a change"))
    code, _, err = call(*arguments)
    assert code == 2
    assert message in err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("arrivals", "solved"),
    [([0.0, 0.0, 0.99, 0.97, 0.0], 23), ([0.0, 0.0, 0.0, 0.0, 0.0], None), ([0.96, 0.97, 0.98, 0.99, 0.0], None)],
)
def test_a_success_is_exported_beside_a_median_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arrivals: list[float], solved: int | None
) -> None:
    runs = [arm for arm in paper_plan(paper(), ["one_waypoint_linear"]).runs() if arm.arm.task.startswith("one_w")]
    utilities = [10.0 * rate + 0.001 * i for i, rate in enumerate(arrivals)]
    results = make_results("one_waypoint_linear", {"mo_a2c": {"utility_esr": utilities, "success": arrivals}})
    exported: dict[str, tuple[Path, dict[str, Any]]] = {}
    monkeypatch.setattr(Job, "open", lambda job: job.path)
    monkeypatch.setattr(paper_report, "export", lambda run, name, about: exported.update({name: (run, about)}))
    names = paper_report.export_policies(runs, results, tmp_path)
    wanted = ["one_waypoint_linear-mo_ppo", "one_waypoint_linear-mo_ppo-solved"]
    assert names == list(exported) == wanted[: 1 if solved is None else 2]
    path, about = exported[wanted[0]]
    median = sorted(utilities)[2]
    assert f"-seed{20 + utilities.index(median)}-" in path.name
    assert about["chosen"] == "median utility_esr of 5 seeds"
    assert about["scores"]["stochastic"]["utility_esr"] == median
    if solved is not None:
        path, about = exported[wanted[1]]
        assert f"-seed{solved}-" in path.name
        assert about["chosen"] == "median utility_esr of the 2 of 5 seeds that arrive in over 95% of the episodes"


# ----------------------------------------------------------------------------------------------- results and reports


def test_results_are_read_as_they_were_written_and_equal_results_give_equal_bytes(tmp_path: Path) -> None:
    results = make_results("one_waypoint_linear", {"a2c": SOLVED, "mo_a2c": {**SOLVED, "extra": evenly_spread(1 / 3)}})
    results.write(tmp_path)
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    again = PaperResults.read(paper(), tmp_path)
    assert again.rows == results.rows
    assert again.curves.equals(results.curves)
    again.write(tmp_path)
    assert files == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert gzip.decompress(files["reproduction_curves.csv.gz"]).startswith(b"task,learner,seed,step,")


def test_truncated_results_are_refused(tmp_path: Path) -> None:
    make_results("one_waypoint_linear", {"a2c": SOLVED}).write(tmp_path)
    curves = tmp_path / "reproduction_curves.csv.gz"
    curves.write_bytes(curves.read_bytes()[:-20])
    with pytest.raises(ValueError, match="no results of a reproduction"):
        PaperResults.read(paper(), tmp_path)


@pytest.mark.slow
def test_the_published_report_follows_from_the_published_results_which_cover_the_whole_study(
    whole: list[ManifestRow], tmp_path: Path
) -> None:
    results = PaperResults.read(paper(), PUBLISHED)
    wanted = {(*arm_of(row), row.seed) for row in whole}
    assert {(row.task, row.learner, row.seed) for row in results.rows} == wanted
    assert set(results.curves.select("task", "learner", "seed").unique().rows()) == wanted
    for number in FIGURES:
        assert list(PUBLISHED.glob(f"figure_{number:02}*.png"))
    write_report(results, tmp_path, [], how="mo-deepdrive reproduce --all")
    made, published = (
        [line for line in (folder / "reproduction.md").read_text("utf-8").splitlines() if line and line[0] != "!"]
        for folder in (tmp_path, PUBLISHED)
    )
    assert made == published


def test_a_report_of_some_tasks_omits_the_others_and_a_quick_one_judges_nothing(tmp_path: Path) -> None:
    scores = {**SOLVED, "end/collision": evenly_spread(0.0), "return/distance": evenly_spread(18.0)}
    results = make_results("one_waypoint_linear", {"a2c": scores, "mo_a2c": scores})
    paths = write_report(results, tmp_path, [4, 5], how="a test", quick=True)
    assert paths == [tmp_path / "reproduction.md", tmp_path / "figure_04.png"]
    text = paths[0].read_text()
    assert [number for number in range(1, 7) if f"## Claim {number}" in text] == [1]
    assert f"**{QUICK}**" in text
    assert "| verdict | not judged |" in text
    assert "| 18.00 [17.99, 18.01] | 0.00 [-0.01, 0.01] | 0.50 [0.14, 0.86] |" in text
    console = Console(width=100, record=True)
    print_verdicts(results, console)
    shown = " ".join(console.export_text().split())
    assert "MO-A2C: success rate above 95% yes: 99.00 [98.93, 99.08]%" in shown
    assert "verdict reproduced" in shown
