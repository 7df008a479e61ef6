"""The table of final scores over seeds, through its command line."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from algorithms.reporting.tables import TABLE_METRICS
from algorithms.runs.config import load_experiment
from algorithms.runs.run_directory import Run
from mo_deepdrive.support.yaml import dump, read_mapping
from tests.helpers.paths import REPOSITORY
from tests.helpers.script_runs import exit_code

ROOT = REPOSITORY
Script = Callable[..., int]  # calls a script with arguments and returns its exit code


@pytest.fixture
def run_table(load_script: Callable[[str], ModuleType]) -> Script:
    return lambda *arguments: exit_code(load_script("table").main, *arguments)


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def pick(rows: list[dict[str, str]], **wanted: str) -> list[dict[str, str]]:
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def make_run(
    folder: Path, config: str, seed: int, scores: dict[str, float] | None, policies: tuple[str, ...] = ("greedy",)
) -> Path:
    """A run directory with the final ``scores`` of some policies; None for a run that is not evaluated."""
    path = folder / f"{config.replace('/', '-')}-{seed}"
    run = Run.create(load_experiment(ROOT / f"configs/{config}.yaml", [f"--seed={seed}"]), path)
    run.unlock()
    if scores is not None:
        run.set_status("finished", 10)
        estimates = {name: {"value": value, "low": None, "high": None} for name, value in scores.items()}
        (path / "evaluation.json").write_text(json.dumps({"policies": dict.fromkeys(policies, estimates)}))
    return path


def make_learner(folder: Path, algorithm: str, seed: int, utility: float) -> Path:
    """A run of one policy, in whose final evaluation every number is ``utility``."""
    scores = dict.fromkeys(TABLE_METRICS, utility)
    return make_run(folder, f"one_waypoint/{algorithm}_linear", seed, scores, ("greedy", "stochastic"))


def test_the_table_gives_means_over_seeds_and_compares_the_algorithms(tmp_path: Path, run_table: Script) -> None:
    scores = {"a2c": [1.0, 2.0, 6.0], "mo_a2c": [11.0, 12.0, 16.0]}
    for algorithm, utilities in scores.items():
        for seed, utility in enumerate(utilities):
            make_learner(tmp_path, algorithm, seed, utility)
    output = tmp_path / "scores.csv"
    assert run_table(tmp_path, "--output", output) == 0
    utilities = pick(read(output), metric="utility_esr")
    assert [(row["algorithm"], row["policy"], row["seeds"], row["n"]) for row in utilities] == [
        (algorithm, policy, "0 1 2", "3") for algorithm in scores for policy in ("greedy", "stochastic")
    ]
    assert [float(utilities[0][name]) for name in ("mean", "low", "high")] == [3.0, 1.0, 6.0]
    assert [row["mean"] for row in pick(read(output), metric="utility_esr_iqm")] == ["3.0"] * 2 + ["13.0"] * 2
    compared = read(tmp_path / "scores-differences.csv")
    assert [row["policy"] for row in compared] == ["greedy", "stochastic"]
    for row in compared:
        assert (row["difference"], row["metric"], row["n"], row["n_other"]) == ("mo_a2c - a2c", "utility_esr", "3", "3")
        assert float(row["mean"]) == pytest.approx(10.0)
        assert float(row["low"]) < 10.0 < float(row["high"])
        assert float(row["p"]) == pytest.approx(0.1)  # the smallest p-value that 3 against 3 can give


def test_tables_are_written_for_papers_and_pages(
    tmp_path: Path, run_table: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    for algorithm in ("a2c", "mo_a2c"):
        for seed in range(3):
            make_learner(tmp_path, algorithm, seed, seed - 5.25)
    for ending in ("tex", "md"):
        assert run_table(tmp_path, "--output", tmp_path / f"table.{ending}") == 0
        written = f"written: {tmp_path}/table.{ending}, {tmp_path}/table-differences.{ending}"
        assert capsys.readouterr().out.splitlines()[-1] == written
    tex = (tmp_path / "table.tex").read_text()
    lines = [line for line in tex.splitlines() if not line.startswith("%")]
    assert lines[2].startswith(r"algorithm & policy & utility per episode & ")
    assert [line.split(" & ")[:3] for line in lines[4:-4]] == [
        [algorithm, policy, "$-$4.2 [$-$5.2, $-$3.2]"]
        for algorithm in ("A2C", "MO-A2C")
        for policy in ("greedy", "stochastic")
    ]
    assert [line.split(" & ")[0] for line in lines[-4:-2]] == ["MO-A2C minus A2C"] * 2
    assert r"% needs \usepackage{booktabs}" in tex
    assert "Every run was evaluated at its end in 1000 episodes of the test split." in tex
    shared, _, header, _, *rows, _, note = (tmp_path / "table.md").read_text().splitlines()
    assert shared.startswith("environment mo-deepdrive-one-waypoint-v0, utility one_waypoint_linear, steps ")
    assert header.startswith("| algorithm | policy | utility per episode | ")
    assert len(rows) == 6
    assert note.startswith("Means over seeds")


def test_columns_are_chosen_by_name_and_say_what_to_cite(
    tmp_path: Path, run_table: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = {"utility_esr": 1.0, "return/g_force": -2.0, "suite/score": 0.5, "success": 1.0}
    for seed in range(3):
        path = make_run(tmp_path, "one_waypoint/a2c_linear", seed, numbers)
        (path / "status.json").unlink()
        config = read_mapping(path / "config.yaml")
        config["evaluation"] |= {"task": "K1", "final_episodes": 50}
        (path / "config.yaml").write_text(dump(config))
    columns = ("--columns", "return/g_force", "suite/score", "utility_esr_iqm")
    for ending in ("tex", "csv"):
        assert run_table(tmp_path, *columns, "--output", tmp_path / f"t.{ending}") == 0
    assert {row["metric"] for row in read(tmp_path / "t.csv")} == {*columns[1:]}
    tex = (tmp_path / "t.tex").read_text()
    assert "g-force (sum, g) & suite/score & utility per episode (IQM)" in tex
    assert "in 50 episodes of the test split. For K1 of the suite cite the score on the scenarios of the task" in tex
    capsys.readouterr()
    assert run_table(tmp_path, "--columns", "return/g_forse") == 2
    assert "--columns return/g_forse: no run has such a score; the nearest: return/g_force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("output", "message"),
    [
        ("t.tsv", "error: --output '{}' must end in .csv or .md or .tex\n"),
        (".csv/t.txt", "error: --output '{}' must end in .csv or .md or .tex\n"),
        ("nowhere/t.csv", "error: --output '{}': '{}' is not a directory\n"),
    ],
)
def test_a_file_that_cannot_be_written_is_refused_before_anything_is_read(
    tmp_path: Path, run_table: Script, capsys: pytest.CaptureFixture[str], output: str, message: str
) -> None:
    path = tmp_path / output
    assert run_table("nowhere", "--output", path) == 2
    assert capsys.readouterr() == ("", message.format(path, path.parent))


def test_every_vehicle_has_a_row_and_there_is_one_for_all_together(tmp_path: Path, run_table: Script) -> None:
    for algorithm, utility in (("a2c", 1.0), ("mo_a2c", 3.0)):
        for seed in (0, 1):
            numbers = {"success": 0.5, "end/collision": 0.25}
            for v in (0, 1):
                numbers |= {f"vehicle_{v}/utility_esr": utility + v, f"vehicle_{v}/return/lane_violation": -2.0}
            make_run(tmp_path, f"paper/intersection_{algorithm}_linear", seed, numbers)
    output = tmp_path / "scores.csv"
    assert run_table(tmp_path, "--output", output) == 0
    found = read(output)
    assert found[0]["environment"] == "mo-deepdrive-intersection-v0 end_together=True"
    first = [row for row in pick(found, algorithm="a2c") if "iqm" not in row["metric"]]
    assert [(row["vehicle"], row["metric"], float(row["mean"])) for row in first] == [
        ("", "success", 0.5),
        ("", "end/collision", 0.25),
        ("vehicle_0", "utility_esr", 1.0),
        ("vehicle_0", "return/lane_violation", -2.0),
        ("vehicle_1", "utility_esr", 2.0),
        ("vehicle_1", "return/lane_violation", -2.0),
    ]
    compared = read(tmp_path / "scores-differences.csv")
    assert [(row["vehicle"], float(row["mean"])) for row in compared] == [("vehicle_0", 2.0), ("vehicle_1", 2.0)]


def test_fronts_have_indicators_and_are_compared_by_hypervolume(tmp_path: Path, run_table: Script) -> None:
    for config, base in (("one_waypoint/pcn", 100.0), ("peers/pcn", 40.0)):
        for seed, more in enumerate((1.0, 2.0, 6.0)):
            numbers = {"hypervolume": base + more, "cardinality": base, "expected_utility": more, "igd_plus": 0.5}
            make_run(tmp_path, config, seed, numbers, ("front",))
    make_learner(tmp_path, "a2c", 0, 5.0)
    output = tmp_path / "scores.csv"
    assert run_table(tmp_path, "--output", output) == 0
    found = read(output)
    for algorithm, base in (("pcn", 100.0), ("morl_baselines.pcn", 40.0)):
        rows = {row["metric"]: row for row in pick(found, algorithm=algorithm, policy="front", utility="")}
        assert list(rows) == ["hypervolume", "cardinality", "expected_utility", "igd_plus"]
        assert [float(row["mean"]) for row in rows.values()] == pytest.approx([base + 3.0, base, 3.0, 0.5])
        assert float(rows["hypervolume"]["low"]) == base + 1.0
    (compared,) = read(tmp_path / "scores-differences.csv")
    assert (compared["difference"], compared["metric"]) == ("morl_baselines.pcn - pcn", "hypervolume")
    assert float(compared["mean"]) == pytest.approx(-60.0)


def test_runs_that_are_not_evaluated_or_finished_are_left_out_and_a_repeated_seed_is_refused(
    tmp_path: Path, run_table: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "runs").mkdir()
    assert run_table(tmp_path / "runs") == 2
    assert "holds no run" in capsys.readouterr().err
    finished, stopped, broken, changed = (make_learner(tmp_path / "runs", "a2c", seed, 1.0) for seed in (0, 1, 2, 4))
    unfinished = make_run(tmp_path / "runs", "one_waypoint/a2c_linear", 3, None)
    Run.open(stopped).set_status("interrupted", 5)
    Run.open(changed).set_status("finished", 10)
    text = (changed / "evaluation.json").read_text()
    (changed / "evaluation.json").write_text(text.replace("1.0", "9.0"))
    (broken / "status.json").write_text("finished")
    output = tmp_path / "scores.csv"
    assert run_table(tmp_path / "runs", "--output", output) == 0
    assert {row["seeds"] for row in read(output)} == {"0"}
    error = capsys.readouterr().err
    assert f"left out: {stopped}: its training is not finished\n" in error
    assert f"left out: {broken}: status.json: cannot be read\n" in error
    assert f"left out: {unfinished}" in error
    assert f"left out: {changed}: evaluation.json: changed since the run finished\n" in error
    make_learner(tmp_path / "again", "a2c", 0, 1.0)
    assert run_table(finished, tmp_path / "again") == 2
    assert "the same seed, 0" in capsys.readouterr().err
