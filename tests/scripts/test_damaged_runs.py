"""One damaged file does not take down the rest: its run is left out with a line, and all others are shown."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from algorithms import zoo
from mo_deepdrive.support.yaml import dump
from tests.helpers.made_up_sweeps import config_of
from tests.helpers.script_runs import Call, refused

HEADER = b"step,eval/greedy/utility_esr\n"
# What is in the file, and how the line about it ends.
METRICS: dict[str, tuple[Any, str]] = {
    "not UTF-8": (HEADER + b"0,\xff\n", "'utf-8' codec can't decode"),
    "no number": (
        HEADER + b"0,1.0\n10,one\n",
        "could not parse `one` as dtype `f64` at column 'eval/greedy/utility_esr'",
    ),
}
FINE = {
    "torn row": HEADER + b"0,1.0\n10,2",
    "huge values": HEADER + b"0,1e308\n5,-1e308\n7,inf\n8,nan\n10,2.0\n",
    "ragged row": HEADER + b"0,1.0\n5\n10,2.0\n",
}
VALUE = "'policies.greedy.utility_esr.value'"
SCORES: dict[str, tuple[Any, str]] = {
    "no JSON": ("{", "is not a final evaluation: Expecting property name"),
    "no policies": ({}, "'policies' is missing"),
    **{
        repr(value): ({"policies": {"greedy": {"utility_esr": {"value": value}}}}, f"{VALUE} = {value!r}: {fault}")
        for value, fault in (
            ("3", "Input should be a valid number"),
            (float("nan"), "Input should be a finite number"),
            (1e300, "must be at most 1e+100 in magnitude"),
        )
    },
}
CONFIGS: dict[str, tuple[Any, str]] = {
    "empty": ("", "is empty; it must be a mapping"),
    "no YAML": ("a: [", "is not valid YAML"),
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


def damage(file: Path, content: Any, base: dict[str, Any] | None = None) -> None:
    if isinstance(content, dict):
        content = json.dumps(content if base is None else {**base, **content})
    file.write_bytes(content if isinstance(content, bytes) else content.encode())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "name", "faults"),
    [
        ("table", "config.yaml", CONFIGS),
        ("table", "evaluation.json", SCORES),
        ("plot", "config.yaml", CONFIGS),
        ("plot", "metrics.csv", METRICS),
    ],
)
def test_damaged_runs_are_left_out_with_a_line_each(
    call: Call, tmp_path: Path, command: str, name: str, faults: dict[str, tuple[Any, str]]
) -> None:
    bad, base = tmp_path / "bad", config_of("one_waypoint/mo_a2c_linear")
    for number, (content, _) in enumerate(faults.values()):
        damage(make_run(bad / str(number), 0) / name, content, base if name == "config.yaml" else None)
    others = [make_run(tmp_path / "good", 7)]
    if command == "table":
        others += [make_run(tmp_path / f"foreign {seed}", seed, **more) for seed, more in enumerate(FOREIGN.values())]
    for seed, content in enumerate(FINE.values() if command == "plot" else []):
        others.append(make_run(tmp_path / f"fine {seed}", seed))
        damage(others[-1] / "metrics.csv", content)
    output = "table.csv" if command == "table" else "curves.png"
    code, out, error = call(command, bad, *others, "--output", output)
    assert (code, (tmp_path / output).exists()) == (0, True)
    shown = ("theirs-v0", "mo_a2c", "theirs") if command == "table" else ("mo_a2c: 4 seeds\n",)
    assert all(text in out for text in shown)
    lines = error.splitlines()
    assert len(lines) == len(faults)
    assert all(line.startswith("left out: ") for line in lines)
    for number, (_, fault) in enumerate(faults.values()):
        assert any(f"{bad}/{number}/{name}" in line and fault in line for line in lines)
    nothing = (
        "no run has a final evaluation that can be read" if command == "table" else "no run whose metrics can be d"
    )
    refused(call(command, bad, "--output", output), nothing)


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
