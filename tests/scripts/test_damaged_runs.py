"""One damaged file does not take down the rest: its run is left out with a line, and all others are shown."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from algorithms import zoo
from mo_deepdrive.support.yaml import dump
from tests.helpers.made_up_sweeps import config_of, make_row, make_sweep
from tests.helpers.script_runs import Call, refused

HEADER = b"step,eval/greedy/utility_esr\n"
# What is in the file, and how the line about it ends.
METRICS = {
    "not UTF-8": (HEADER + b"0,\xff\n", "'utf-8' codec can't decode"),
    "no step": (b"eval/greedy/utility_esr\n1.0\n", "its columns must be 'step', then different metrics"),
    "no number": (
        HEADER + b"0,1.0\n10,one\n",
        "could not parse `one` as dtype `f64` at column 'eval/greedy/utility_esr'",
    ),
    "columns twice": (b"step,a,a\n0,1,2\n", "its columns must be 'step', then different metrics"),
}
NO_ROWS = {"empty": b"", "header alone": HEADER, "torn row alone": HEADER + b"0,1."}
FINE = {
    "torn row": HEADER + b"0,1.0\n10,2",
    "huge values": HEADER + b"0,1e308\n5,-1e308\n7,inf\n8,nan\n10,2.0\n",
    "ragged row": HEADER + b"0,1.0\n5\n10,2.0\n",
}
SCORES: dict[str, tuple[Any, str]] = {
    "no JSON": ("{", "is not a final evaluation: Expecting property name"),
    "nested": ("[" * 100_000, "is not a final evaluation: maximum recursion depth exceeded"),
    "a list": ([1], "'policies' is missing"),
    "no policies": ({}, "'policies' is missing"),
    "a bare number": ({"policies": {"greedy": {"utility_esr": 1}}}, "'policies.greedy.utility_esr' = 1: Input should"),
    **{
        f"value {value!r}": (
            {"policies": {"greedy": {"utility_esr": {"value": value}}}},
            f"'policies.greedy.utility_esr.value' = {value!r}: Input should be a {kind} number",
        )
        for value, kind in (("3", "valid"), (float("nan"), "finite"))
    },
    "a huge value": (
        {"policies": {"greedy": {"utility_esr": {"value": 1e300}}}},
        "'policies.greedy.utility_esr.value' = 1e+300: must be at most 1e+100 in magnitude",
    ),
    "no value": ({"policies": {"greedy": {"utility_esr": {}}}}, "'policies.greedy.utility_esr.value' is missing"),
}
CONFIGS: dict[str, tuple[Any, str]] = {
    "empty": ("", "is empty; it must be a mapping"),
    "no YAML": ("a: [", "is not valid YAML"),
    "not UTF-8": (b"a: \xff", "cannot be read: 'utf-8' codec"),
    "nested": ("a: " + "{a: " * 5000, "is nested too deeply"),
    "no utility.name": ({"utility": {}}, "'utility.name' is missing"),
    "algorithm is missing": ({"algorithm": None}, "'algorithm' = None: Input should be a valid dictionary"),
    "seed as text": ({"training": {"seed": "3"}}, "'training.seed' = '3': Input should be a valid integer"),
}
FOREIGN: dict[str, Any] = {
    "utility null": {"utility": None},
    "unknown algorithm": {"algorithm": {"name": "theirs", "since": "2024-01-01"}},
    "unknown environment": {"environment": {"id": "theirs-v0"}},
}


def make_run(path: Path, seed: int, **sections: Any) -> Path:
    path.mkdir(parents=True)
    config = config_of("one_waypoint/mo_a2c_linear")
    config["training"]["seed"] = seed
    (path / "config.yaml").write_text(dump({**config, **sections}))
    (path / "metrics.csv").write_bytes(HEADER + b"0,1.0\n10,2.0\n")
    scores = {"utility_esr": {"value": 1.0, "low": None, "high": None}}
    (path / "evaluation.json").write_text(json.dumps({"policies": {"greedy": scores}}))
    return path


def left_out(error: str, folder: Path, name: str) -> dict[str, str]:
    """The lines about runs that are left out, by the name of the run."""
    lines = error.splitlines()
    for line in lines:
        assert line.startswith("left out: ")
        assert line.count(str(folder)) == 1
    return {line.partition(f"{folder}/")[2].partition(f"/{name}")[0]: line for line in lines}


def check(error: str, folder: Path, name: str, faults: dict[str, tuple[Any, str]]) -> None:
    found = left_out(error, folder, name)
    assert list(found) == sorted(faults)
    for which, (_, fault) in faults.items():
        assert fault in found[which]


def damage(file: Path, content: Any, base: dict[str, Any] | None = None) -> None:
    if isinstance(content, dict | list):
        content = json.dumps(content if base is None else {**base, **content})
    file.write_bytes(content if isinstance(content, bytes) else content.encode())


def test_runs_with_damaged_configs_or_scores_are_left_out_of_tables(call: Call, tmp_path: Path) -> None:
    base = config_of("one_waypoint/mo_a2c_linear")
    for which, (content, _) in CONFIGS.items():
        damage(make_run(tmp_path / "configs" / which, 0) / "config.yaml", content, base)
    for which, (content, _) in SCORES.items():
        damage(make_run(tmp_path / "scores" / which, 0) / "evaluation.json", content)
    good = make_run(tmp_path / "good", 7)
    for seed, sections in enumerate(FOREIGN.values()):
        make_run(tmp_path / "foreign" / str(seed), seed, **sections)
    for folder, name, faults in (("configs", "config.yaml", CONFIGS), ("scores", "evaluation.json", SCORES)):
        code, out, error = call("table", tmp_path / folder, good, tmp_path / "foreign", "--output", "t.csv")
        assert code == 0
        assert all(text in out for text in ("theirs-v0", "mo_a2c", "theirs"))
        check(error, tmp_path / folder, name, faults)
        refused(call("table", tmp_path / folder), "no run has a final evaluation that can be read")
    assert (tmp_path / "t.csv").read_text().count("utility_esr,") == 4


@pytest.mark.slow
def test_runs_with_damaged_configs_or_metrics_are_left_out_of_figures(call: Call, tmp_path: Path) -> None:
    base = config_of("one_waypoint/mo_a2c_linear")
    for which, (content, _) in CONFIGS.items():
        damage(make_run(tmp_path / "configs" / which, 0) / "config.yaml", content, base)
    for which, (content, _) in METRICS.items():
        damage(make_run(tmp_path / "metrics" / which, 0) / "metrics.csv", content)
    good = make_run(tmp_path / "good", 7)
    for seed, content in enumerate(FINE.values()):
        damage(make_run(tmp_path / "fine" / str(seed), seed) / "metrics.csv", content)
    for folder, name, faults in (("configs", "config.yaml", CONFIGS), ("metrics", "metrics.csv", METRICS)):
        code, out, error = call("plot", tmp_path / folder, good, tmp_path / "fine", "--output", "curves.png")
        assert code == 0
        assert out.startswith("mo_a2c: 4 seeds\n")
        check(error, tmp_path / folder, name, faults)
        (tmp_path / "curves.png").unlink()
        refused(call("plot", tmp_path / folder, "--output", "curves.png"), "no run whose metrics can be drawn")
    for which, content in NO_ROWS.items():
        damage(make_run(tmp_path / "no rows" / which, 0) / "metrics.csv", content)
    code, _, error = call("plot", tmp_path / "no rows", good, "--output", "curves.png")
    assert (code, error.count("has no metrics yet")) == (0, len(NO_ROWS))


@pytest.mark.slow
def test_a_run_with_damaged_metrics_is_not_resumed_before_they_are_repaired_or_deleted(
    call: Call, tmp_path: Path
) -> None:
    run = make_run(tmp_path / "run", 0)
    for content, fault in METRICS.values():
        (run / "metrics.csv").write_bytes(content)
        done = call("train", "--resume", run)
        advice = "; repair it, or delete it to resume without its rows\n"
        refused(done, f"metrics file '{run}/metrics.csv'", fault, advice)
        assert done[2].count("\n") == 1
        assert (run / "metrics.csv").read_bytes() == content


@pytest.mark.slow
def test_a_front_that_cannot_be_read_is_left_out_of_the_explorer(call: Call, tmp_path: Path) -> None:
    front = zoo.find("one_waypoint_front-pcn")
    for which in ("config.yaml", "front.csv", "evaluation.json", "checkpoint.safetensors"):
        bad = tmp_path / f"bad-{which.partition('.')[0]}"
        shutil.copytree(front, bad)
        (bad / which).write_bytes(b"\n\0\xff")
    folders = [path.name for path in sorted(tmp_path.iterdir())]
    code, _, error = call("explore", *folders, front.name, "--output", "page.html", "--episodes", "1")
    assert code == 0
    lines = [line for line in error.splitlines() if line.startswith("left out: ")]
    assert [[folder in line for folder in folders].count(True) for line in lines] == [1] * len(folders)
    assert (tmp_path / "page.html").is_file()
    for folder in folders:
        refused(call("choose", folder, "--weights", "distance=1"), folder)
    refused(call("explore", *folders, "--output", "page.html"), "none of the runs has a front that can be read")
    refused(call("explore", "nowhere", front.name, "--output", "page.html"), "'nowhere' is not a run directory")


@pytest.mark.slow
def test_damaged_runs_do_not_take_down_their_sweep(call: Call, tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    base = config_of("one_waypoint/mo_a2c_linear")
    count = max(len(METRICS), len(SCORES)) + 1
    rows = make_sweep(sweep, [make_row(base, {}, seed) for seed in range(count)], points=3)
    broken = 0
    for name, faults in (("metrics.csv", METRICS), ("evaluation.json", SCORES)):
        broken += len(faults)
        for row, (content, _) in zip(rows[1:], faults.values(), strict=False):
            damage(sweep / row.directory / name, content)
        for _ in range(2):  # also when nothing is read again
            code, out, error = call("table", sweep, "--output", "t.csv")
            assert code == 0
            assert (f"{count - len(faults)} of {count}" in out) is (name == "evaluation.json")
            assert error.startswith(f"left out: {broken} files cannot be read: ")
            assert error.count("\n") == 1
    (sweep / rows[1].directory / "status.json").write_text('{"state": "finished", "step": 1' + "0" * 40 + "}")
    (sweep / rows[2].directory / "status.json").write_bytes(b"\0")
    code, out, _ = call("plot", sweep, "--output", "curves.png")
    assert (code, out) == (0, "mo_a2c: 1 seed\ncurves.png\n")
