"""The reproduction of the paper: its plan, its scores, its verdicts, its figures, and its command line."""

from __future__ import annotations

import gzip
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.helpers.paths import REPOSITORY

ROOT = REPOSITORY
sys.path.insert(0, str(ROOT / "scripts"))

import reproduce  # noqa: E402  (a script)

from algorithms.reproduction.claims import CLAIMS, Claim, compare  # noqa: E402
from algorithms.reproduction.figures import CURVES, FIGURES, draw_curves  # noqa: E402
from algorithms.reproduction.plan import Plan, entries, load_plan  # noqa: E402
from algorithms.reproduction.report import (  # noqa: E402
    BEGIN,
    END,
    insert_verdicts,
    is_study,
    verdict_table,
    write_report,
)
from algorithms.reproduction.results import Results, gather  # noqa: E402

PLAN = ROOT / "configs" / "reproduce.yaml"
PUBLISHED = ROOT / "docs" / "results"
SEEDS = 5
TINY = """
first_seed: 3
seeds: 2
quick_seeds: 1
overrides: {evaluation.final_episodes: 4, evaluation.episodes: 4, logging.save_figures: false}
cells:
  one_waypoint_linear:
    title: OneWaypoint, linear utility
    arms:
      best:
        title: best effort
        quick_timesteps: 400
        overrides: {algorithm.hidden: [8], training.total_timesteps: 800, training.num_envs: 4, algorithm.steps: 10,
          environment.arguments.time_limit: 2}
        variants:
          a2c: {label: A2C, config: configs/one_waypoint/a2c_linear.yaml}
          mo_a2c: {label: MO-A2C, config: configs/one_waypoint/mo_a2c_linear.yaml}
      study:
        title: one thing changed
        seeds: 1
        overrides: {algorithm.hidden: [8], training.total_timesteps: 400, training.num_envs: 4, algorithm.steps: 10}
        variants:
          all: {label: nothing changed, config: configs/one_waypoint/mo_a2c_linear.yaml}
          gamma: {label: no discount, config: configs/one_waypoint/mo_a2c_linear.yaml,
            overrides: {algorithm.gamma: 1.0}}
"""


def claim(number: int) -> Claim:
    return next(claim for claim in CLAIMS if claim.number == number)


def made_up(
    cell: str, scores: dict[str, dict[str, list[float]]], arm: str = "best", policy: str = "stochastic"
) -> Results:
    """Results with one score per variant, metric and seed, and curves that rise to them."""
    rows, curves = [], []
    for variant, metrics in scores.items():
        for i in range(len(next(iter(metrics.values())))):
            keys = {"cell": cell, "arm": arm, "variant": variant, "label": variant, "seed": 20 + i, "steps": 1000}
            values = {name: float(each[i]) for name, each in metrics.items()}
            rows.append({**keys, "seconds": 2.5, "policy": policy, **values})
            for step in (0, 500, 1000):
                curves.append({**keys, "step": step, **{f"{policy}/{k}": v * step / 1000 for k, v in values.items()}})
    return Results(rows, curves)


def around(value: float, spread: float = 0.01, count: int = SEEDS) -> list[float]:
    return (value + spread * np.linspace(-1.0, 1.0, count)).tolist()


# The plan.


def test_every_run_of_the_plan_has_a_valid_config_a_seed_and_a_folder_of_its_own(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    wanted = entries(plan, list(plan.cells), tmp_path, root=ROOT)
    assert len({entry.job.path for entry in wanted}) == len(wanted) > 100
    seeds = {entry.seed for entry in wanted}
    assert min(seeds) == plan.first_seed
    assert not seeds & set(range(5)) | seeds & set(range(100, 210))  # those of other tables, and of tuning
    for entry in wanted:
        assert entry.job.experiment.training.seed == entry.seed
        assert entry.job.experiment.evaluation.seed == 1_000_000
        assert not entry.job.experiment.logging.save_figures


def test_every_claim_and_figure_has_its_cells_in_the_plan() -> None:
    plan = load_plan(PLAN)
    assert [each.number for each in CLAIMS] == [1, 2, 3, 4, 5, 6]
    assert {figure for each in CLAIMS for figure in each.figures} == set(FIGURES) == {4, 5, 6, 7, 8, 9, 10}
    for each in CLAIMS:
        for cell in each.cells:
            assert {"printed", "best"} <= set(plan.cells[cell].arms)
    for figure in CURVES.values():
        assert set(figure.cells) <= set(plan.cells)


def test_both_algorithms_of_an_arm_have_the_same_budget_networks_and_environment(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    compared = 0
    for key, cell in plan.cells.items():
        for arm_key, arm in cell.arms.items():
            if set(arm.variants) != {"a2c", "mo_a2c"}:
                continue
            mine = [e.job.experiment for e in entries(plan, [key], tmp_path, seeds=1, root=ROOT) if e.arm == arm_key]
            for name in ("hidden", "steps", "learning_rate", "epochs", "minibatches"):
                assert mine[0].algorithm.get(name) == mine[1].algorithm.get(name), (key, arm_key, name)
            assert mine[0].training == mine[1].training
            assert mine[0].environment == mine[1].environment
            compared += 1
    # Six cells as printed and with best effort, two of them in the paper's setting too, and continuous actions.
    assert compared == 2 * 6 + 2 + 1


def test_a_quick_reproduction_is_a_shorter_one_of_the_same(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    whole = {(e.cell, e.arm, e.variant): e for e in entries(plan, list(plan.cells), tmp_path, root=ROOT)}
    quick = entries(plan, list(plan.cells), tmp_path, quick=True, root=ROOT)
    seeds = {
        (e.cell, e.arm): {other.seed for other in quick if (other.cell, other.arm) == (e.cell, e.arm)} for e in quick
    }
    assert {len(each) for each in seeds.values()} == {plan.quick_seeds}
    for entry in quick:
        other = whole[entry.cell, entry.arm, entry.variant].job.experiment
        assert entry.job.experiment.training.total_timesteps < other.training.total_timesteps
        assert entry.job.experiment.algorithm == other.algorithm
        assert entry.job.experiment.evaluation.final_episodes == 200 < other.evaluation.final_episodes
        assert entry.job.experiment.evaluation.interval * 5 == entry.job.experiment.training.total_timesteps
    assert {(e.cell, e.arm) for e in quick} >= {(cell, "best") for each in CLAIMS for cell in each.cells}


def test_a_plan_that_is_wrong_is_refused_with_the_place(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(TINY.replace("quick_seeds", "quick_seed"))
    with pytest.raises(ValueError, match=r"plan .*quick_seed"):
        load_plan(path)
    path.write_text(TINY.replace("algorithm.gamma", "algorithm.gama"))
    with pytest.raises(ValueError, match=r"one_waypoint_linear/study/gamma: .*gama.*gamma"):
        entries(load_plan(path), ["one_waypoint_linear"], tmp_path, root=ROOT)
    path.write_text(TINY)
    with pytest.raises(ValueError, match=r"cell 'one_waypoint_lineal' is unknown.*one_waypoint_linear"):
        entries(load_plan(path), ["one_waypoint_lineal"], tmp_path, root=ROOT)


# Verdicts.

SOLVED = {"utility_esr": around(10.0), "success": around(0.99, 0.001)}


@pytest.mark.parametrize(
    ("utility", "arrivals", "word"),
    [
        (around(10.1), around(0.99, 0.001), "comes out"),
        (around(9.0), around(0.99, 0.001), "does not come out"),  # a tenth apart
        (around(10.5, 2.0), around(0.99, 0.001), "undecided"),
        (around(10.1), around(0.5, 0.001), "does not come out"),  # alike, but not solved
        (around(10.1), around(0.95, 0.04), "undecided"),
    ],
)
def test_claim_1_asks_that_both_solve_it_alike(utility: list[float], arrivals: list[float], word: str) -> None:
    scores = {"a2c": SOLVED, "mo_a2c": {"utility_esr": utility, "success": arrivals}}
    verdict = claim(1).judge(made_up("one_waypoint_linear", scores), "best")
    assert verdict is not None
    assert verdict.word == word


@pytest.mark.parametrize(
    ("utility", "word"),
    [
        (around(23.0, 0.01), "comes out"),
        (around(23.0, 0.5), "does not come out"),  # higher, but less consistent
        (around(19.0, 0.01), "does not come out"),  # more consistent, but lower
        (around(22.0, 0.1), "undecided"),
    ],
)
def test_claim_2_asks_that_mo_a2c_is_higher_and_steadier(utility: list[float], word: str) -> None:
    scores = {"a2c": {"utility_esr": around(22.0, 0.1)}, "mo_a2c": {"utility_esr": utility}}
    verdict = claim(2).judge(made_up("one_waypoint_nonlinear", scores), "best")
    assert verdict is not None
    assert verdict.word == word


def test_claim_4_asks_that_a2c_does_not_learn_and_drives_away() -> None:
    good = {"success": around(0.9), "return/distance": around(18.0)}
    bad = {"success": around(0.0, 0.0), "return/distance": around(-30.0, 1.0)}
    standing = {"success": around(0.0, 0.0), "return/distance": around(1.0)}
    for a2c, mo_a2c, word in (
        (bad, good, "comes out"),
        (good, good, "does not come out"),
        (bad, bad, "does not come out"),
    ):
        verdict = claim(4).judge(made_up("static_obstacle_nonlinear", {"a2c": a2c, "mo_a2c": mo_a2c}), "best")
        assert verdict is not None
        assert verdict.word == word
    verdict = claim(4).judge(made_up("static_obstacle_nonlinear", {"a2c": standing, "mo_a2c": good}), "best")
    assert verdict is not None
    assert [check.holds for check in verdict.checks] == [True, True, False]


@pytest.mark.parametrize(
    ("arrivals", "total", "word"),
    [(0.0, -3.0, "comes out"), (0.0, -9.0, "does not come out"), (0.9, -3.0, "does not come out")],
)
def test_claim_5_asks_that_both_fail_and_mo_a2c_less(arrivals: float, total: float, word: str) -> None:
    failing = {"success": around(0.0, 0.001, 4), "total_utility_esr": around(-5.0, 0.1, 4)}
    other = {"success": around(arrivals, 0.001, 4), "total_utility_esr": around(total, 0.1, 4)}
    parts = [
        made_up(cell, {"a2c": failing, "mo_a2c": other}, arm="printed")
        for cell in ("intersection_linear", "intersection_nonlinear")
    ]
    results = Results([row for part in parts for row in part.scores], [])
    verdict = claim(5).judge(results, "printed")
    assert verdict is not None
    assert verdict.word == word
    assert claim(5).judge(parts[0], "printed") is None  # half of the results is no verdict


def test_claim_6_asks_for_many_policies_from_standing_to_arriving() -> None:
    broad = {"cardinality": around(80.0, 5.0), "lowest_distance": around(0.0), "highest_distance": around(14.5)}
    narrow = {**broad, "lowest_distance": around(12.0)}
    for scores, word in ((broad, "comes out"), (narrow, "does not come out")):
        verdict = claim(6).judge(made_up("one_waypoint_front", {"pcn": scores}, policy="front"), "best")
        assert verdict is not None
        assert verdict.word == word


def test_one_seed_decides_nothing() -> None:
    scores = {"a2c": {"utility_esr": [10.0], "success": [0.99]}, "mo_a2c": {"utility_esr": [10.0], "success": [0.99]}}
    verdict = claim(1).judge(made_up("one_waypoint_linear", scores), "best")
    assert verdict is not None
    assert verdict.word == "undecided"


def test_a_claim_without_results_has_no_verdict() -> None:
    assert claim(1).judge(Results([], []), "best") is None
    with pytest.raises(KeyError, match="one_waypoint_linear/best/a2c"):
        compare(Results([], []), "one_waypoint_linear", "best", "utility_esr")


# Files.


def test_results_survive_being_written_and_the_same_results_are_the_same_bytes(tmp_path: Path) -> None:
    results = made_up("one_waypoint_linear", {"a2c": SOLVED, "mo_a2c": {**SOLVED, "extra": around(1.0 / 3.0)}})
    results.write(tmp_path)
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    again = Results.read(tmp_path)
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
    assert gzip.decompress(files["reproduction_curves.csv.gz"]).startswith(b"cell,arm,variant,label,seed,steps,step,")


@pytest.mark.parametrize("damage", ["missing", "not gzip", "torn"])
def test_broken_results_are_refused(tmp_path: Path, damage: str) -> None:
    with pytest.raises(ValueError, match="no results of a reproduction"):
        Results.read(tmp_path)
    made_up("one_waypoint_linear", {"a2c": SOLVED}).write(tmp_path)
    curves = tmp_path / "reproduction_curves.csv.gz"
    data = curves.read_bytes()
    curves.unlink() if damage == "missing" else curves.write_bytes(b"x" if damage == "not gzip" else data[:-20])
    with pytest.raises(ValueError, match="no results of a reproduction"):
        Results.read(tmp_path)


def test_a_figure_shows_every_seed_in_the_colours_of_both_algorithms(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    scores = {"a2c": {"utility_esr": around(5.0, 1.0)}, "mo_a2c": {"utility_esr": around(9.0, 1.0)}}
    parts = [made_up(cell, scores) for cell in CURVES[4].cells]
    results = Results([row for part in parts for row in part.scores], [row for part in parts for row in part.curves])
    assert draw_curves(4, plan, results, tmp_path / "figure.png")
    picture = np.asarray(Image.open(tmp_path / "figure.png").convert("RGB")).reshape(-1, 3)
    for colour in ((0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)):
        assert (np.abs(picture.astype(int) - colour).max(axis=1) < 8).sum() > 500
    assert not draw_curves(5, plan, results, tmp_path / "nothing.png")
    assert not (tmp_path / "nothing.png").exists()


def test_the_verdicts_are_put_between_their_marks_and_nothing_else_changes(tmp_path: Path) -> None:
    plan, path = load_plan(PLAN), tmp_path / "README.md"
    results = made_up("one_waypoint_linear", {"a2c": SOLVED, "mo_a2c": SOLVED})
    path.write_text(f"before\n\n{BEGIN}\nold\n{END}\n\nafter \\1\n")
    insert_verdicts(path, plan, results)
    once = path.read_text()
    assert once.startswith("before\n\n")
    assert once.endswith("after \\1\n")
    assert "**comes out**" in once
    assert "old" not in once
    insert_verdicts(path, plan, results)
    assert path.read_text() == once
    path.write_text("no marks")
    with pytest.raises(ValueError, match="no place for the verdicts"):
        insert_verdicts(path, plan, results)


# What is published.

published = pytest.mark.skipif(
    not (PUBLISHED / "reproduction_scores.csv").exists(), reason="there are no published results"
)


@published
def test_the_readme_and_the_report_say_what_the_published_scores_say(tmp_path: Path) -> None:
    plan, results = load_plan(PLAN), Results.read(PUBLISHED)
    table = verdict_table(plan, results)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert readme.split(BEGIN)[1].split(END)[0].strip() == table
    assert table in (PUBLISHED / "reproduction.md").read_text(encoding="utf-8")


@published
def test_the_published_scores_are_those_of_the_whole_plan(tmp_path: Path) -> None:
    plan, results = load_plan(PLAN), Results.read(PUBLISHED)
    wanted = {(e.cell, e.arm, e.variant, e.seed) for e in entries(plan, list(plan.cells), tmp_path, root=ROOT)}
    assert {(row["cell"], row["arm"], row["variant"], row["seed"]) for row in results.scores} == wanted
    assert {(row["cell"], row["arm"], row["variant"], row["seed"]) for row in results.curves} == wanted
    for figure in FIGURES:
        assert list(PUBLISHED.glob(f"figure_{figure:02}*.png"))


# The command line.


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    (tmp_path / "plan.yaml").write_text(TINY)
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> tuple[int, str, str]:
        code = reproduce.main(["--plan", "plan.yaml", "--workers", "2", *arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def test_what_is_missing_is_trained_and_everything_is_written_and_the_second_time_nothing_is_left(
    call: Callable[..., Any], tmp_path: Path
) -> None:
    code, out, err = call("--claim", "1")
    assert (code, err) == (0, "")
    assert "6 runs, 6 of them to be made" in out
    results = tmp_path / "runs" / "reproduce" / "results"
    report = (results / "reproduction.md").read_text()
    assert "python scripts/reproduce.py --claim 1" in report
    assert "no discount" in report
    assert "![Figure 4](figure_04.png)" in report
    assert (results / "figure_04.png").exists()
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("checkpoint.safetensors")}
    code, out, _ = call("--claim", "1")
    assert code == 0
    assert " 0 of them to be made" in out
    assert before == {path: path.stat().st_mtime_ns for path in before}
    found = Results.read(results)
    gathered = gather(entries(load_plan("plan.yaml"), ["one_waypoint_linear"], Path("runs/reproduce"), root=ROOT))
    assert [row["seed"] for row in found.scores] == [row["seed"] for row in gathered.scores]
    assert {row["policy"] for row in found.scores} == {"greedy", "stochastic"}
    (results / "reproduction.md").unlink()
    code, _, _ = call("--claim", "1", "--redraw", "--output", str(results))
    assert code == 0
    assert verdict_table(load_plan("plan.yaml"), found) in (results / "reproduction.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "0"], "--seeds 0 must be at least 1"),
        (["--redraw", "--quick"], "--redraw trains nothing"),
        (["--redraw", "--output", "nowhere"], "no results of a reproduction in 'nowhere'"),
        (["--plan", "other.yaml"], "config file 'other.yaml' does not exist"),
        (["--claim", "2"], "cell 'one_waypoint_nonlinear' is unknown"),
    ],
)
def test_what_cannot_be_meant_is_refused_before_anything_is_trained(
    call: Callable[..., Any], tmp_path: Path, arguments: list[str], message: str
) -> None:
    code, _, err = call(*arguments)
    assert code == 2
    assert message in err
    assert not (tmp_path / "runs").exists()


def test_a_run_of_another_plan_in_the_folder_is_refused(call: Callable[..., Any], tmp_path: Path) -> None:
    assert call("--quick", "--runs", "mine")[0] == 0
    code, _, err = call("--runs", "mine", "--output", "out")
    assert code == 2
    assert re.search(r"holds another experiment: training.total_timesteps = 400 there, 800 wanted", err)


def test_studies_are_told_from_comparisons() -> None:
    plan = Plan.model_validate(load_plan(PLAN).model_dump())
    arms = plan.cells["one_waypoint_nonlinear"].arms
    assert [key for key, arm in arms.items() if is_study(arm)] == ["without"]


def test_a_report_of_some_cells_leaves_the_others_out(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    results = made_up(
        "one_waypoint_linear",
        {
            "a2c": {**SOLVED, "end/collision": around(0.0), "return/distance": around(18.0)},
            "mo_a2c": {**SOLVED, "end/collision": around(0.0), "return/distance": around(18.0)},
        },
    )
    greedy = [{**row, "policy": "greedy"} for row in results.scores]
    paths = write_report(plan, Results([*results.scores, *greedy], results.curves), tmp_path, [4, 5], how="a test")
    text = (tmp_path / "reproduction.md").read_text()
    assert "## Claim 1" in text
    assert "## Claim 2" not in text
    assert paths == [tmp_path / "reproduction.md", tmp_path / "figure_04.png"]
