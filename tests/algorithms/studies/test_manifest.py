"""The manifest: the runs of a sweep, their ids and directories, and its file."""

from __future__ import annotations

import copy
import datetime
import math
import os
import re
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from algorithms.reporting.run_records import flatten
from algorithms.runs import config
from algorithms.runs.config import make_experiment
from algorithms.studies.manifest import (
    FILE,
    ManifestRow,
    Scores,
    read_manifest,
    run_id,
    write_manifest,
)
from algorithms.studies.plan import SweepPlan
from algorithms.studies.settings import load_sweep
from mo_deepdrive.support.extras import MissingExtraError
from tests.helpers.short_runs import VALUES
from tests.helpers.sweep_files import run_sweep, write_sweep

RATE = "algorithm.learning_rate"
METRIC = "greedy/utility_esr"


class KnownScores(Scores):
    """Scores by the ids of runs."""

    def __init__(self, known: Mapping[str, float] | None = None):
        self._known = known or {}

    def of(self, row: ManifestRow, metric: str) -> float | None:
        return self._known.get(row.id, math.nan)


def expanded(folder: Path, scores: Mapping[str, float] | None = None, **settings: Any) -> list[ManifestRow]:
    """The runs of a sweep."""
    return rows_of(write_sweep(folder, **settings), scores)


def rows_of(file: Path | str, scores: Mapping[str, float] | None = None) -> list[ManifestRow]:
    """The runs of a sweep's file."""
    return SweepPlan(load_sweep(file)).rows(KnownScores(scores))


def refused_cells(folder: Path, **settings: Any) -> str:
    """The error message for a sweep with invalid cells."""
    with pytest.raises(ValueError, match="cell") as error:
        expanded(folder, **settings)
    return str(error.value)


def write_yaml(path: Path, values: Mapping[str, Any]) -> Path:
    """A YAML file whose keys are in the order of ``values``."""
    path.write_text(yaml.safe_dump(dict(values), sort_keys=False))
    return path


@pytest.mark.slow
def test_the_manifest_is_the_same_in_another_directory_and_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"grid": {RATE: [0.001, 0.003], "algorithm.steps": [8, 16]}, "seeds": 2}
    file = write_sweep(tmp_path, **settings)
    here = b"".join(row.line() for row in rows_of(file))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    shutil.copy(file, elsewhere)
    monkeypatch.chdir(elsewhere)
    assert b"".join(row.line() for row in rows_of("short.yaml")) == here
    write_yaml(tmp_path / "base.yaml", dict(reversed(VALUES.items())))
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    done = run_sweep(elsewhere / "short.yaml", "--on", "manifest", "--output", "made", environment=environment)
    assert done.returncode == 0
    assert done.stdout == f"{Path('made') / FILE}: 8 runs\n"
    assert [path.name for path in (elsewhere / "made").iterdir()] == [FILE]
    assert (elsewhere / "made" / FILE).read_bytes() == here


UTILITY = {"name": "augmented_chebyshev", "arguments": {"weights": [1, 1, 1, 1], "ideal": [0, 0, 0, 0], "rho": 0.1}}


def test_cells_are_in_the_order_of_the_file_and_seeds_in_order_within_each_cell(tmp_path: Path) -> None:
    bases = [str(write_yaml(tmp_path / f"{name}.yaml", VALUES)) for name in ("second", "first")]
    settings = {
        "config": bases,
        "grid": {"training.num_envs": [4, 2], RATE: [0.003, 0.001]},
        "seeds": [5, 1],
    }
    write_yaml(tmp_path / "second.yaml", {**VALUES, "algorithm": {**VALUES["algorithm"], "gamma": 0.5}})
    rows = rows_of(write_yaml(tmp_path / "sweep.yaml", settings))
    assert [(*row.cell.values(), row.seed) for row in rows] == [
        (name, envs, rate, seed)
        for name in ("second", "first")
        for envs in (4, 2)
        for rate in (0.003, 0.001)
        for seed in (5, 1)
    ]
    for row in rows:
        assert row.config["training"]["num_envs"] == row.cell["training.num_envs"]
        assert row.config["algorithm"]["learning_rate"] == row.cell[RATE]
        assert row.config["algorithm"]["gamma"] == (0.5 if row.cell["config"] == "second" else 0.99)
        assert row.config["training"]["seed"] == row.seed
        assert row.directory == f"runs/mo_a2c-seed{row.seed}-{row.id}"
    assert len({row.id for row in rows}) == len(rows) == 16


def test_the_id_of_a_run_changes_with_every_single_setting_that_affects_its_result() -> None:
    values = copy.deepcopy(VALUES)
    values["logging"]["wandb"] = {"project": "p", "tags": ["t"]}
    resolved = make_experiment(values).to_dict()
    ids, ignored = {run_id(resolved)}, []
    for key in flatten(resolved):
        changed = copy.deepcopy(resolved)
        config.override(changed, key, "another")
        if key.startswith("logging.") or key in ("training.device", "training.seeds", "training.threads"):
            ignored.append(key)
            assert run_id(changed) == run_id(resolved), key
        else:
            assert run_id(changed) not in ids, key
            ids.add(run_id(changed))
    assert len(ignored) >= 8
    assert run_id({**resolved, "logging": {}}) == run_id(resolved)


def test_an_explicit_default_gives_the_same_run(tmp_path: Path) -> None:
    plain = expanded(tmp_path)
    written = expanded(tmp_path, overrides={"evaluation.interval": 48, "algorithm.gamma": 0.99})
    assert [row.id for row in plain] == [row.id for row in written]


def test_two_cells_with_the_same_run_are_refused_by_name(tmp_path: Path) -> None:
    said = refused_cells(tmp_path, grid={"training.device": ["cpu", "cuda"]}, seeds=[4])
    assert "training.device=cpu] and " in said
    assert "training.device=cuda] have the same run (seed 4, " in said


@pytest.mark.parametrize(
    ("grid", "cell", "message"),
    [
        (
            {"utility.name": ["one_waypoint_linear", "static_obstacle_linear"]},
            "utility.name=static_obstacle_linear",
            "needs collision",
        ),
        ({"training.device": ["quantum"]}, "training.device=quantum", "is not a valid device"),
        # YAML has dates, JSON does not.
        ({"utility.arguments.since": [datetime.date(2024, 1, 1)]}, "2024-01-01", "utility.arguments.since"),
    ],
)
def test_a_cell_that_cannot_be_built_is_refused_by_name(
    tmp_path: Path, grid: dict[str, Any], cell: str, message: str
) -> None:
    said = refused_cells(tmp_path, grid=grid)
    assert cell in said
    assert message in said


def test_a_manifest_is_read_as_it_was_written(tmp_path: Path) -> None:
    rows = expanded(tmp_path, grid={"utility": [UTILITY], RATE: [1e-3, 0.1 + 0.2]}, seeds=3)
    path = write_manifest(tmp_path / "a" / "sweep", rows)
    assert read_manifest(tmp_path / "a" / "sweep") == rows
    assert len(path.read_text().splitlines()) == len(rows)
    assert [entry.name for entry in path.parent.iterdir()] == [FILE]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('"seed":', '"sead":', "seed = "),
        ('"directory":"runs/', '"directory":"runs/../', "directory = 'runs/../"),
    ],
)
def test_a_line_that_no_sweep_writes_is_refused_with_its_number(
    tmp_path: Path, old: str, new: str, problem: str
) -> None:
    path = write_manifest(tmp_path / "sweep", expanded(tmp_path, seeds=1))
    first, second = path.read_text().splitlines()
    path.write_text(f"{first}\n{second.replace(old, new, 1)}\n")
    with pytest.raises(ValueError, match=re.escape(f"manifest {str(path)!r} is broken in line 2: {problem}")):
        read_manifest(tmp_path / "sweep")


def test_the_error_without_optuna_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(MissingExtraError, match=r"a search needs optuna: pip install --editable '\.\[sweep\]'"):
        expanded(tmp_path, search={"space": {RATE: [1e-3]}, "metric": METRIC, "trials": 1})
    assert len(expanded(tmp_path)) == 2  # a sweep without a search does not need Optuna


def test_a_search_adds_its_points_to_every_cell_of_the_grid(tmp_path: Path) -> None:
    settings = {
        "grid": {"algorithm.steps": [8, 16]},
        "seeds": 2,
        "search": {"space": {RATE: {"low": 1e-4, "high": 1e-2}}, "metric": METRIC, "trials": 5, "batch": 3},
    }
    rows = expanded(tmp_path, **settings)
    assert [(row.cell["algorithm.steps"], row.trial, row.seed) for row in rows] == [
        (steps, trial, seed) for steps in (8, 16) for trial in range(3) for seed in (0, 1)
    ]
    for row in rows:
        assert row.config["algorithm"]["learning_rate"] == row.cell[RATE]
        assert row.config["algorithm"]["steps"] == row.cell["algorithm.steps"]
    scores = {row.id: 1.0 for row in rows if row.cell["algorithm.steps"] == 16}
    more = expanded(tmp_path, scores, **settings)
    assert [(row.cell["algorithm.steps"], row.trial) for row in more if row.seed == 0] == [
        *((8, trial) for trial in range(3)),
        *((16, trial) for trial in range(5)),
    ]
    partly = dict.fromkeys(list(scores)[1:], 1.0)
    assert expanded(tmp_path, partly, **settings) == rows


def test_a_search_is_scored_on_the_validation_split(tmp_path: Path) -> None:
    search = {"space": {RATE: [1e-3]}, "metric": METRIC, "trials": 1, "sampler": "random"}
    for row in expanded(tmp_path, search=search):
        assert row.config["evaluation"]["split"] == "validation"
    said = refused_cells(tmp_path, search=search, overrides={"evaluation.split": "test"})
    assert "evaluation.split = 'test': settings are chosen by the final scores, which needs 'validation'" in said
    said = refused_cells(tmp_path, search={**search, "metric": "greedy/utility_ers"})
    assert "metric 'greedy/utility_ers' is unknown; the nearest ones: greedy/utility_ser, greedy/utility_esr, " in said
    misspelt = {**search, "space": {"algorithm.step": [8]}}
    assert "did you mean 'steps'?" in refused_cells(tmp_path, search=misspelt)
    assert expanded(tmp_path)[0].config["evaluation"]["split"] == "test"
