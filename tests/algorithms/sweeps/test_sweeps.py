"""Sweeps: what their file may say, the manifest that follows from it, the points of a search, the scores of runs."""

from __future__ import annotations

import copy
import csv
import json
import math
import os
import random
import shutil
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from algorithms.experiments.config import make_experiment
from algorithms.experiments.jobs import Job, perform
from algorithms.sweeps.manifest import FILE, Row, expand, label, manifest_bytes, read_manifest, run_id, write_manifest
from algorithms.sweeps.scores import final_metrics, read_scores
from algorithms.sweeps.search import propose
from algorithms.sweeps.settings import SearchSettings, load_sweep
from mo_deepdrive.config import parse
from tests.helpers.short_runs import VALUES, job
from tests.helpers.sweep_files import run_sweep, write_sweep

RATE = "algorithm.learning_rate"
METRIC = "greedy/utility_esr"


def refused(folder: Path, **settings: Any) -> str:
    """Why a sweep's file is refused."""
    with pytest.raises(ValueError, match="invalid sweep") as error:
        load_sweep(write_sweep(folder, **settings))
    return str(error.value)


def expanded(folder: Path, scores: Mapping[str, float | None] | None = None, **settings: Any) -> list[Row]:
    """The runs of a sweep."""
    return expand(load_sweep(write_sweep(folder, **settings)), scores or {})


def wrong(folder: Path, **settings: Any) -> str:
    """Why the cells of a sweep are refused."""
    with pytest.raises(ValueError, match="cell") as error:
        expanded(folder, **settings)
    return str(error.value)


def write_yaml(path: Path, values: Mapping[str, Any]) -> Path:
    """A YAML file whose keys are in the order of ``values``."""
    path.write_text(yaml.safe_dump(dict(values), sort_keys=False))
    return path


# ------------------------------------------------------------------------------------------------------------ settings


@pytest.mark.parametrize(
    ("settings", "messages"),
    [
        ({"seedz": 3}, ["'seedz' is unknown", "did you mean 'seeds'?"]),
        ({"slurm": {"partion": "x"}}, ["'slurm.partion' is unknown", "did you mean 'partition'?"]),
        ({"ray": {"asha": {"metrik": "x"}}}, ["'ray.asha.metrik' is unknown", "did you mean 'metric'?"]),
        (
            {"search": {"space": {RATE: {"lo": 1}}, "metric": "m", "trials": 1}},
            [f"'search.space.{RATE}.lo' is unknown", "did you mean 'low'?"],
        ),
        ({"overrides": {RATE: 0.1}}, [f"'{RATE}' is in overrides and in grid"]),
        ({"grid": {"seed": [1, 2]}}, ["'seed' in grid: seeds have a key of their own"]),
        ({"grid": {"training.seed": [1]}}, ["'training.seed' in grid"]),
        ({"overrides": {"training.seed": 1}}, ["'training.seed' in overrides"]),
        ({"seeds": [3, 5, 3]}, ["[3, 5, 3] has a seed twice"]),
        ({"seeds": []}, ["'seeds' = []"]),
        ({"seeds": 0}, ["'seeds' = 0"]),
        ({"seeds": -2}, ["'seeds' = -2"]),
        ({"seeds": [-1]}, ["'seeds.0' = -1"]),
        ({"seeds": [2**31]}, [f"'seeds.0' = {2**31}"]),
        ({"seeds": True}, ["'seeds' = True"]),
        ({"seeds": 2.5}, ["'seeds' = 2.5"]),
        ({"grid": {RATE: []}}, [f"'grid.{RATE}' = []"]),
        ({"grid": {RATE: 0.1}}, [f"'grid.{RATE}' = 0.1", "list"]),
        ({"config": []}, ["'config' = []"]),
        ({"config": 3}, ["'config' = 3"]),
        ({"retries": -1}, ["'retries' = -1"]),
        ({"resources": {"cpus": 0}}, ["'resources.cpus' = 0"]),
        ({"resources": {"minutes": "an hour"}}, ["'resources.minutes' = 'an hour'"]),
        ({"resources": {"memory_gb": math.nan}}, ["'resources.memory_gb' = nan"]),
        ({"overrides": None}, ["'overrides' = None"]),
    ],
)
def test_a_setting_that_cannot_be_meant_is_refused_by_its_name(
    tmp_path: Path, settings: dict[str, Any], messages: list[str]
) -> None:
    said = refused(tmp_path, **settings)
    assert "short.yaml" in said
    for message in messages:
        assert message in said


def test_everything_that_is_wrong_with_a_file_is_said_at_once(tmp_path: Path) -> None:
    said = refused(tmp_path, overrides={RATE: 1, "seed": 3}, seeds=[1, 1])
    assert said.count(";") == 2
    for message in (f"'{RATE}' is in overrides and in grid", "'seed' in overrides", "has a seed twice"):
        assert message in said


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"low": 3, "high": 2}, "low = 3 is above high = 2"),
        ({"low": 0, "high": 2, "log": True}, "low = 0 must be positive"),
        ({"low": -1.0, "high": 2.0, "log": True}, "low = -1.0 must be positive"),
        ({"low": 1, "high": 8, "log": True, "step": 2}, "a logarithmic range has no step"),
        ({"low": 1, "high": 8, "step": 0}, "step = 0 must be positive"),
        ({"low": 1, "high": 8, "step": -0.5}, "step = -0.5 must be positive"),
        ({"choices": [1, 2], "low": 0}, "choices stand alone"),
        ({"choices": [1, 2], "log": False}, "choices stand alone"),
        ({"choices": []}, "choices' = []"),
        ([], "choices' = []"),
        ({"low": 1}, "needs 'low' and 'high'"),
        ({"high": 1}, "needs 'low' and 'high'"),
        ({}, "needs 'low' and 'high', or 'choices'"),
        ({"low": math.nan, "high": 1}, "= nan"),
        ({"low": 0, "high": math.inf}, "= inf"),
        ({"low": "a", "high": 1}, "= 'a'"),
        ({"low": True, "high": 2}, "= True"),
        ({"low": 0, "high": 2, "log": "yes"}, "'search.space.algorithm.learning_rate.log' = 'yes'"),
        (3, "= 3"),
    ],
)
def test_a_range_that_cannot_be_meant_is_refused_with_its_key(tmp_path: Path, values: Any, message: str) -> None:
    said = refused(tmp_path, search={"space": {RATE: values}, "metric": METRIC, "trials": 1})
    assert f"search.space.{RATE}" in said
    assert message in said


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"trials": 0}, "search.trials"),
        ({"batch": 0}, "search.batch"),
        ({"space": {}}, "search.space"),
        ({"sampler": "grid"}, "search.sampler"),
        ({"direction": "up"}, "search.direction"),
        ({"metric": 3}, "search.metric"),
        ({"seed": -1}, "search.seed"),
    ],
)
def test_a_search_that_cannot_be_meant_is_refused_with_its_key(
    tmp_path: Path, values: dict[str, Any], name: str
) -> None:
    said = refused(tmp_path, search={"space": {RATE: [1, 2]}, "metric": METRIC, "trials": 1, **values})
    assert f"'{name}' = " in said


def test_a_search_needs_a_metric_and_trials(tmp_path: Path) -> None:
    said = refused(tmp_path, search={"space": {RATE: [1, 2]}})
    assert "'search.metric' is missing" in said
    assert "'search.trials' is missing" in said


def test_a_key_in_two_places_is_refused_also_between_grid_and_search(tmp_path: Path) -> None:
    said = refused(tmp_path, grid={RATE: [1]}, search={"space": {RATE: [1, 2]}, "metric": METRIC, "trials": 1})
    assert f"'{RATE}' is in grid and in search.space" in said


def test_a_number_of_seeds_is_short_for_those_from_nought(tmp_path: Path) -> None:
    number, listed = (load_sweep(write_sweep(tmp_path, seeds=seeds)) for seeds in (3, [0, 1, 2]))
    assert number.seeds == listed.seeds == [0, 1, 2]
    assert load_sweep(write_sweep(tmp_path, seeds=[7, 2])).seeds == [7, 2]


def test_one_config_and_one_list_of_choices_are_short_forms(tmp_path: Path) -> None:
    settings = load_sweep(write_sweep(tmp_path, search={"space": {RATE: [1, 2]}, "metric": METRIC, "trials": 1e1}))
    assert settings.config == [str(tmp_path / "base.yaml")]
    assert settings.search is not None
    assert settings.search.space[RATE].choices == [1, 2]
    assert settings.search.trials == 10


def test_a_file_that_is_not_there_or_not_a_mapping_is_refused_by_its_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"nothing\.yaml' does not exist"):
        load_sweep(tmp_path / "nothing.yaml")
    (tmp_path / "list.yaml").write_text("- 1\n")
    with pytest.raises(ValueError, match=r"list\.yaml' holds a list"):
        load_sweep(tmp_path / "list.yaml")


# ------------------------------------------------------------------------------------------------------------ manifest


def test_the_manifest_is_the_same_elsewhere_and_in_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"grid": {RATE: [0.001, 0.003], "algorithm.steps": [8, 16]}, "seeds": 2}
    file = write_sweep(tmp_path, **settings)
    here = manifest_bytes(expand(load_sweep(file), {}))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    shutil.copy(file, elsewhere)
    monkeypatch.chdir(elsewhere)
    assert manifest_bytes(expand(load_sweep("short.yaml"), {})) == here
    write_yaml(tmp_path / "base.yaml", dict(reversed(VALUES.items())))
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    done = run_sweep(elsewhere / "short.yaml", "--on", "manifest", "--output", "made", environment=environment)
    assert done.returncode == 0
    assert done.stdout == f"{Path('made') / FILE}: 8 runs\n"
    assert [path.name for path in (elsewhere / "made").iterdir()] == [FILE]
    assert (elsewhere / "made" / FILE).read_bytes() == here


UTILITY = {"name": "augmented_chebyshev", "arguments": {"weights": [1, 1, 1, 1], "ideal": [0, 0, 0, 0], "rho": 0.1}}


def reordered(values: Any, generator: random.Random) -> Any:
    """The same value, with the keys of every mapping in another order."""
    if not isinstance(values, Mapping):
        return values
    keys = list(values)
    generator.shuffle(keys)
    return {key: reordered(values[key], generator) for key in keys}


@pytest.mark.parametrize("utility", [VALUES["utility"], UTILITY], ids=["without", "with"])
def test_the_order_of_keys_in_a_base_config_does_not_change_a_byte(tmp_path: Path, utility: dict[str, Any]) -> None:
    """With and without arguments of a utility, which are not in a fixed order by themselves."""
    file = write_sweep(tmp_path, seeds=2)
    found = set()
    for number in range(8):
        write_yaml(tmp_path / "base.yaml", reordered({**VALUES, "utility": utility}, random.Random(number)))
        found.add(manifest_bytes(expand(load_sweep(file), {})))
    assert len(found) == 1


def test_cells_are_in_the_order_of_the_file_and_seeds_within_them(tmp_path: Path) -> None:
    bases = [str(write_yaml(tmp_path / f"{name}.yaml", VALUES)) for name in ("second", "first")]
    settings = {
        "config": bases,
        "overrides": {"evaluation.episodes": 3},
        "grid": {"training.num_envs": [4, 2], RATE: [0.003, 0.001]},
        "seeds": [5, 1],
    }
    write_yaml(tmp_path / "second.yaml", {**VALUES, "algorithm": {**VALUES["algorithm"], "gamma": 0.5}})
    rows = expand(load_sweep(write_yaml(tmp_path / "sweep.yaml", settings)), {})
    assert [(*row.cell.values(), row.seed) for row in rows] == [
        (name, envs, rate, seed)
        for name in ("second", "first")
        for envs in (4, 2)
        for rate in (0.003, 0.001)
        for seed in (5, 1)
    ]
    for row in rows:
        assert list(row.cell) == ["config", "training.num_envs", RATE]
        assert row.config["training"]["num_envs"] == row.cell["training.num_envs"]
        assert row.config["algorithm"]["learning_rate"] == row.cell[RATE]
        assert row.config["algorithm"]["gamma"] == (0.5 if row.cell["config"] == "second" else 0.99)
        assert row.config["training"]["seed"] == row.seed
        assert row.config["evaluation"]["episodes"] == 3
        assert row.directory == f"runs/mo_a2c-seed{row.seed}-{row.id}"
        assert row.trial is None
    assert len({row.id for row in rows}) == len(rows) == 16


def test_base_configs_of_the_same_name_are_told_apart_by_their_paths(tmp_path: Path) -> None:
    paths = []
    for folder, gamma in (("a", 0.5), ("b", 0.6)):
        (tmp_path / folder).mkdir()
        values = {**VALUES, "algorithm": {**VALUES["algorithm"], "gamma": gamma}}
        paths.append(str(write_yaml(tmp_path / folder / "same.yaml", values)))
    rows = expand(load_sweep(write_yaml(tmp_path / "sweep.yaml", {"config": paths})), {})
    assert [row.cell["config"] for row in rows] == paths


def test_without_a_grid_every_base_config_is_a_cell(tmp_path: Path) -> None:
    (row,) = expanded(tmp_path, grid={})
    assert row.cell == {}
    assert row.name == f"seed 0 ({row.id})"
    assert row.config == make_experiment({**VALUES, "training": {**VALUES["training"], "seed": 0}}).to_dict()


def test_a_mapping_is_merged_into_its_section(tmp_path: Path) -> None:
    first, second = expanded(
        tmp_path,
        overrides={"evaluation": {"episodes": 7}},
        grid={"training": [{"num_envs": 2, "total_timesteps": 480}, {"num_envs": 6}]},
    )
    for row in (first, second):
        assert row.config["evaluation"]["episodes"] == 7
        assert row.config["evaluation"]["final_episodes"] == VALUES["evaluation"]["final_episodes"]
    assert [row.config["training"]["num_envs"] for row in (first, second)] == [2, 6]
    assert [row.config["training"]["total_timesteps"] for row in (first, second)] == [480, 960]
    assert label(first.cell) == 'training={"num_envs": 2, "total_timesteps": 480}'


def test_what_is_merged_in_one_cell_is_not_in_the_next(tmp_path: Path) -> None:
    linear = {"name": "linear", "arguments": {"weights": [1, 1, 1, 1]}}
    rows = expanded(tmp_path, grid={"utility": [UTILITY, linear]})
    assert [row.config["utility"]["arguments"] for row in rows] == [UTILITY["arguments"], linear["arguments"]]


def test_a_cell_says_what_the_file_says_also_where_another_key_goes_into_the_same_mapping(tmp_path: Path) -> None:
    arguments = {"weights": [1, 1, 1, 1], "ideal": [0, 0, 0, 0]}
    grid = {"utility.arguments": [arguments], "utility.arguments.rho": [0.1, 0.2]}
    rows = expanded(tmp_path, overrides={"utility.name": "augmented_chebyshev"}, grid=grid)
    assert [row.cell for row in rows] == [
        {"utility.arguments": arguments, "utility.arguments.rho": rho} for rho in (0.1, 0.2)
    ]
    assert [row.config["utility"]["arguments"] for row in rows] == [arguments | {"rho": rho} for rho in (0.1, 0.2)]


@pytest.fixture(scope="module")
def resolved() -> dict[str, Any]:
    """A resolved experiment, with Weights & Biases."""
    values = copy.deepcopy(VALUES)
    values["logging"]["wandb"] = {"project": "p", "tags": ["t"]}
    return make_experiment(values).to_dict()


def leaves(values: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Paths of all values that are not mappings, or empty ones."""
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, (*path, key))
        else:
            yield (*path, key)


def changed(values: Mapping[str, Any], path: tuple[str, ...], value: Any) -> dict[str, Any]:
    """A copy with another value in one place."""
    result = copy.deepcopy(dict(values))
    place = result
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return result


def at(values: Any, path: tuple[str, ...]) -> Any:
    """The value in one place."""
    for key in path:
        values = values[key]
    return values


def is_free(path: tuple[str, ...]) -> bool:
    """Whether a place says only where and how loudly a run is made."""
    return path[0] == "logging" or path in (("training", "device"), ("training", "threads"))


SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text()
JSON = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3), max_leaves=6
)


@given(data=st.data())
def test_the_id_of_a_run_changes_with_everything_but_where_and_how_loudly_it_is_made(
    resolved: dict[str, Any], data: st.DataObject
) -> None:
    path = data.draw(st.sampled_from(sorted(leaves(resolved))))
    value = data.draw(JSON)
    other = changed(resolved, path, value)
    same = is_free(path) or json.dumps(at(resolved, path), sort_keys=True) == json.dumps(value, sort_keys=True)
    assert (run_id(other) == run_id(resolved)) == same


def test_the_id_of_a_run_changes_with_each_setting_of_the_environment_the_algorithm_and_the_rest(
    resolved: dict[str, Any],
) -> None:
    ids = {(): run_id(resolved)}
    free = []
    for path in leaves(resolved):
        if is_free(path):
            free.append(path)
            assert run_id(changed(resolved, path, "another")) == ids[()], path
        else:
            ids[path] = run_id(changed(resolved, path, "another"))
    assert len(set(ids.values())) == len(ids)
    assert len(free) >= 8
    assert {path[0] for path in ids if path} == {"environment", "utility", "algorithm", "training", "evaluation"}
    assert run_id(changed(resolved, ("logging",), {})) == ids[()]


@given(seed=st.integers(0, 2**32))
def test_the_id_of_a_run_does_not_depend_on_the_order_of_keys(resolved: dict[str, Any], seed: int) -> None:
    assert run_id(reordered(resolved, random.Random(seed))) == run_id(resolved)


def test_runs_that_differ_in_device_threads_or_logging_have_the_same_directory(tmp_path: Path) -> None:
    plain = expanded(tmp_path, seeds=2)
    other = expanded(
        tmp_path,
        seeds=2,
        overrides={
            "training.device": "cuda:7",
            "training.threads": 3,
            "logging": {"interval": 1, "checkpoint_interval": 5, "save_figures": True, "wandb": {"project": "p"}},
        },
    )
    assert [row.directory for row in plain] == [row.directory for row in other]
    assert other[0].config["training"]["device"] == "cuda:7"
    assert other[0].config["logging"]["wandb"]["project"] == "p"


def test_a_default_written_down_is_the_same_run(tmp_path: Path) -> None:
    plain = expanded(tmp_path)
    written = expanded(tmp_path, overrides={"evaluation.interval": 48, "algorithm.gamma": 0.99})
    assert [row.id for row in plain] == [row.id for row in written]


@pytest.mark.parametrize(
    ("grid", "first", "second"),
    [
        ({RATE: [0.001, 0.002, 1e-3]}, f"{RATE}=0.001", f"{RATE}=0.001"),
        ({"training.device": ["cpu", "cuda"]}, "training.device=cpu", "training.device=cuda"),
        ({"logging.interval": [1, 2]}, "logging.interval=1", "logging.interval=2"),
        ({"algorithm.gamma": [0.5, 0.99], "training.threads": [1, 2]}, "gamma=0.5 training.threads=1", "threads=2"),
    ],
)
def test_two_cells_that_are_the_same_run_are_refused_by_name(
    tmp_path: Path, grid: dict[str, Any], first: str, second: str
) -> None:
    said = wrong(tmp_path, grid=grid, seeds=[4])
    assert "have the same run (seed 4, " in said
    one, other = said.split(" have the same run")[0].split(" and ")
    assert one.endswith(f"{first}]")
    assert other.endswith(f"{second}]")


def test_a_wrong_key_in_one_cell_is_refused_with_the_cell_and_the_nearest_name(tmp_path: Path) -> None:
    said = wrong(tmp_path, grid={"training": [{"num_envs": 4}, {"num_env": 2}], "algorithm.steps": [8]})
    assert said.startswith("1 of 2 cells are wrong:\n")
    assert 'cell [training={"num_env": 2} algorithm.steps=8]' in said or (
        'cell [algorithm.steps=8 training={"num_env": 2}]' in said
    )
    assert "'training.num_env' is unknown; did you mean 'num_envs'?" in said


@pytest.mark.parametrize("count", [2, 5, 6, 9])
def test_wrong_cells_are_all_named_up_to_five(tmp_path: Path, count: int) -> None:
    rates = [-1.0 - number for number in range(count)]
    said = wrong(tmp_path, grid={RATE: [0.1, *rates]})
    assert said.startswith(f"{count} of {count + 1} cells are wrong:\n")
    named = [rate for rate in rates if f"cell [{RATE}={rate}]" in said]
    assert named == rates[:5]
    assert (f"and {count - 5} more" in said) == (count > 5)
    assert len(said.splitlines()) == 1 + min(count, 5) + (count > 5)


@pytest.mark.parametrize(
    ("grid", "cell", "message"),
    [
        (
            {"utility.name": ["one_waypoint_linear", "static_obstacle_linear"]},
            "utility.name=static_obstacle_linear",
            "'collision'",
        ),
        ({"utility": [{"name": "linear", "arguments": {"weights": [1, 2]}}]}, "weights", "must be 4 finite numbers"),
        ({"utility": [{"name": "linear", "arguments": {"weights": [math.nan] * 4}}]}, "NaN", "4 finite numbers"),
        ({"utility.name": ["nowhere_to_be:found"]}, "utility.name=nowhere_to_be:found", "cannot be imported"),
        ({"utility.name": ["statistics:median_low"]}, "statistics:median_low", "fails on returns"),
        ({"utility.vehicles": [{"vehicle_7": UTILITY}]}, "vehicle_7", "vehicle_0"),
        ({"algorithm.learning_rate.deeper": [1]}, "algorithm.learning_rate.deeper=1", "learning_rate"),
        ({"training.device": ["quantum"]}, "training.device=quantum", "no device"),
        ({"environment.id": ["mo-deepdrive-one-waypint-v0"]}, "one-waypint", "mo-deepdrive-one-waypoint-v0"),
        ({"algorithm.name": ["mo_a2d"]}, "algorithm.name=mo_a2d", "'mo_a2c'"),
    ],
)
def test_a_cell_that_could_not_begin_is_refused_by_name(
    tmp_path: Path, grid: dict[str, Any], cell: str, message: str
) -> None:
    said = wrong(tmp_path, grid=grid)
    assert cell in said
    assert message in said


def test_a_cell_whose_way_leads_through_a_value_is_refused_by_name(tmp_path: Path) -> None:
    said = wrong(tmp_path, grid={"environment.id.deeper": [1]})
    assert "cell [environment.id.deeper=1]" in said
    assert "is not a section" in said


def test_a_date_in_a_cell_is_refused_by_name(tmp_path: Path) -> None:
    """YAML has dates, JSON has not."""
    file = write_sweep(tmp_path)
    values = yaml.safe_load(file.read_text())
    file.write_text(yaml.safe_dump({key: values[key] for key in values if key != "grid"}))
    with file.open("a") as text:
        text.write("grid:\n  utility.arguments.since: [2024-01-01]\n")
    with pytest.raises(ValueError, match=r"utility\.arguments\.since"):
        expand(load_sweep(file), {})


def test_a_device_that_this_machine_does_not_have_is_for_another(tmp_path: Path) -> None:
    (row,) = expanded(tmp_path, grid={}, overrides={"training.device": "cuda:99"})
    assert row.config["training"]["device"] == "cuda:99"
    assert row.job(tmp_path).experiment.training.device == "cuda:99"


def test_a_row_is_a_job_with_the_same_experiment(tmp_path: Path) -> None:
    row = expanded(tmp_path, seeds=[3])[1]
    wanted = row.job(tmp_path / "sweep")
    assert wanted.path == tmp_path / "sweep" / row.directory
    assert wanted.id == row.id
    assert wanted.name == f"{RATE}=0.003 seed 3 ({row.id})"
    assert wanted.experiment.to_dict() == row.config
    assert Job.unpack(json.loads(json.dumps(wanted.packed()))) == wanted


def test_a_manifest_reads_back_as_it_was_written(tmp_path: Path) -> None:
    rows = expanded(tmp_path, grid={"utility": [UTILITY], RATE: [1e-3, 0.1 + 0.2]}, seeds=3)
    path = write_manifest(tmp_path / "a" / "sweep", rows)
    assert read_manifest(tmp_path / "a" / "sweep") == rows
    assert len(path.read_text().splitlines()) == len(rows)
    assert [entry.name for entry in path.parent.iterdir()] == [FILE]


@given(
    rows=st.lists(
        st.builds(
            Row,
            id=st.text(max_size=12),
            directory=st.text(),
            cell=st.dictionaries(st.text(), JSON, max_size=3),
            seed=st.integers(0, 2**31 - 1),
            trial=st.none() | st.integers(0, 1000),
            config=st.dictionaries(st.text(), JSON, max_size=3),
        ),
        max_size=4,
    )
)
def test_any_rows_read_back_as_they_were_written(tmp_path_factory: pytest.TempPathFactory, rows: list[Row]) -> None:
    folder = tmp_path_factory.getbasetemp() / "any_rows"
    write_manifest(folder, rows)
    assert read_manifest(folder) == rows


@pytest.mark.parametrize(
    "broken",
    [
        lambda line: line[: len(line) // 2],
        lambda line: b"",
        lambda line: b"[1, 2]",
        lambda line: b"null",
        lambda line: line.replace(b'"seed"', b'"sead"', 1),
        lambda line: line.replace(b'{"id"', b'{"more":1,"id"', 1),
        lambda line: b"\xff\xfe" + line,
    ],
    ids=["torn", "empty", "list", "null", "without a field", "with a field more", "not text"],
)
def test_a_broken_manifest_is_refused_with_its_line(tmp_path: Path, broken: Callable[[bytes], bytes]) -> None:
    path = write_manifest(tmp_path / "sweep", expanded(tmp_path, seeds=2))
    lines = path.read_bytes().splitlines()
    lines[2] = broken(lines[2])
    path.write_bytes(b"\n".join(lines) + b"\n")
    with pytest.raises(ValueError, match="is broken in line 3") as error:
        read_manifest(tmp_path / "sweep")
    assert str(path) in str(error.value)


def test_a_directory_without_a_manifest_is_no_sweep(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"is not a sweep: it has no manifest\.jsonl"):
        read_manifest(tmp_path)


# -------------------------------------------------------------------------------------------------------------- search


def search(**settings: Any) -> SearchSettings:
    """The settings of a search for the learning rate, unless told otherwise."""
    space = {RATE: {"low": 1e-4, "high": 1e-2, "log": True}}
    return parse(SearchSettings, {"space": space, "metric": METRIC, "trials": 6, **settings}, "search")


def points(settings: SearchSettings, scores: Mapping[str, float | None] | None = None) -> list[dict[str, Any]]:
    """The points that are chosen; the run of the trial with number n is "n"."""
    found: list[dict[str, Any]] = []

    def runs_of(trial: int, point: dict[str, Any]) -> list[str]:
        assert trial == len(found)
        found.append(point)
        return [str(trial)]

    propose(settings, runs_of, scores or {})
    return found


@st.composite
def intervals(draw: st.DrawFn) -> dict[str, Any]:
    """Ranges that are allowed."""
    if draw(st.booleans()):
        low = draw(st.integers(1, 1000))
        high = low + draw(st.integers(0, 1000))
        step = draw(st.none() | st.integers(1, 7))
    else:
        low = draw(st.floats(1e-6, 10.0))
        high = low + draw(st.floats(0.0, 100.0))
        step = draw(st.none() | st.floats(0.01, 3.0))
    values: dict[str, Any] = {"low": low, "high": high}
    if step is None:
        values["log"] = draw(st.booleans())
    else:
        values["step"] = step
    return values


@pytest.mark.filterwarnings("ignore:The distribution is specified by")
@given(values=intervals(), seed=st.integers(0, 1000), sampler=st.sampled_from(["random", "tpe"]))
def test_points_are_within_their_bounds_and_on_their_steps(values: dict[str, Any], seed: int, sampler: str) -> None:
    found = points(search(space={"a.b": values}, seed=seed, sampler=sampler, trials=8))
    assert len(found) == 8
    low, high, step = values["low"], values["high"], values.get("step")
    for point in found:
        assert list(point) == ["a.b"]
        value = point["a.b"]
        assert low <= value <= high
        assert type(value) is type(low)
        if step is not None:
            assert (value - low) / step == pytest.approx(round((value - low) / step), abs=1e-6)


def test_whole_ends_give_whole_numbers_unless_the_step_is_a_fraction() -> None:
    space = {
        "whole": {"low": 1, "high": 9},
        "halves": {"low": 1, "high": 9, "step": 0.5},
        "real": {"low": 1, "high": 2.0},
    }
    found = points(search(space=space, sampler="random", trials=60))
    assert {type(point["whole"]) for point in found} == {int}
    assert {point["whole"] for point in found} == set(range(1, 10))
    assert any(point["halves"] % 1 == 0.5 for point in found)
    assert {type(point["real"]) for point in found} == {float}


def test_a_logarithmic_range_is_spread_over_orders_of_magnitude() -> None:
    space = {"log": {"low": 1e-6, "high": 1.0, "log": True}, "even": {"low": 1e-6, "high": 1.0}}
    found = points(search(space=space, sampler="random", trials=300))
    assert -3.5 < statistics.median(math.log10(point["log"]) for point in found) < -2.5
    assert 0.4 < statistics.median(point["even"] for point in found) < 0.6


@pytest.mark.filterwarnings("ignore:Choices for a categorical distribution")
def test_choices_are_what_they_are() -> None:
    choices = [None, True, 3, 0.5, "word", [8, 8], {"steps": 8}]
    found = points(search(space={"a": choices}, sampler="random", trials=100))
    assert {json.dumps(point["a"]) for point in found} == {json.dumps(choice) for choice in choices}


def test_a_random_search_chooses_all_points_at_once_whatever_the_scores() -> None:
    settings = search(sampler="random", trials=20, batch=2)
    found = points(settings)
    assert len(found) == 20
    assert points(settings, {str(trial): float(trial) for trial in range(20)}) == found
    assert len({point[RATE] for point in found}) == 20
    assert points(search(sampler="random", trials=20, seed=1)) != found


def test_tpe_chooses_a_batch_when_all_scores_of_those_before_are_there() -> None:
    settings = search(trials=10, batch=4)
    scores: dict[str, float | None] = {str(trial): float(trial) for trial in range(10)}
    first = points(settings)
    assert len(first) == 4
    for missing in range(4):
        known = {run: score for run, score in scores.items() if run != str(missing)}
        assert points(settings, known) == first
    second = points(settings, {run: scores[run] for run in "0123"})
    assert len(second) == 8
    assert second[:4] == first
    assert len(points(settings, {run: scores[run] for run in "01234567"})) == 10
    assert points(settings, scores)[:8] == second
    assert len(points(settings, scores)) == 10
    assert points(search(trials=10, batch=4, seed=1)) != first


def curve(point: dict[str, Any]) -> float:
    """A score that is best for a learning rate of 0.001."""
    return -((math.log10(point[RATE]) + 3) ** 2)


def searched(settings: SearchSettings, score: Callable[[int, dict[str, Any]], float | None]) -> list[dict[str, Any]]:
    """All points of a search, batch after batch."""
    scores: dict[str, float | None] = {}
    while True:
        found = points(settings, scores)
        if len(found) == len(scores):
            return found
        scores |= {str(trial): score(trial, found[trial]) for trial in range(len(scores), len(found))}


def test_tpe_is_determined_by_the_scores_and_comes_closer_to_the_best() -> None:
    settings = search(trials=36, batch=6)
    found = searched(settings, lambda trial, point: curve(point))
    assert searched(settings, lambda trial, point: curve(point)) == found
    other = searched(settings, lambda trial, point: -curve(point))
    assert other[:6] == found[:6]
    assert other[-6:] != found[-6:]
    assert np.mean([curve(point) for point in found[-12:]]) > np.mean([curve(point) for point in found[:12]])
    minimised = searched(search(trials=36, batch=6, direction="minimize"), lambda trial, point: -curve(point))
    assert np.mean([curve(point) for point in minimised[-12:]]) > np.mean([curve(point) for point in minimised[:12]])


@pytest.fixture
def studies(monkeypatch: pytest.MonkeyPatch) -> list[optuna.Study]:
    """The studies that are made from here on."""
    made: list[optuna.Study] = []
    create = optuna.create_study

    def keep(**options: Any) -> optuna.Study:
        made.append(create(**options))
        return made[-1]

    monkeypatch.setattr(optuna, "create_study", keep)
    return made


def test_the_mean_over_seeds_counts_and_failed_runs_are_told_as_such(studies: list[optuna.Study]) -> None:
    scores = {"0a": 1.0, "0b": 4.0, "1a": 2.0, "1b": None, "2a": None, "2b": None, "3a": -1.0, "3b": -2.0}
    found = []

    def runs_of(trial: int, point: dict[str, Any]) -> list[str]:
        found.append(trial)
        return [f"{trial}a", f"{trial}b"]

    propose(search(trials=6, batch=4, direction="minimize"), runs_of, scores)
    assert found == [0, 1, 2, 3, 4, 5]
    (study,) = studies
    assert study.direction == optuna.study.StudyDirection.MINIMIZE
    states = [trial.state.name for trial in study.trials]
    assert states == ["COMPLETE", "FAIL", "FAIL", "COMPLETE", "RUNNING", "RUNNING"]
    assert [study.trials[trial].value for trial in (0, 3)] == [2.5, -1.5]


def test_without_optuna_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ValueError, match=r"pip install 'mo-deepdrive\[sweep\]'"):
        expanded(tmp_path, search={"space": {RATE: [1e-3]}, "metric": METRIC, "trials": 1})
    assert len(expanded(tmp_path)) == 2  # a sweep without a search does not need it


def test_a_search_makes_cells_of_its_points_in_every_cell_of_the_grid(tmp_path: Path) -> None:
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
    scores: dict[str, float | None] = {row.id: 1.0 for row in rows if row.cell["algorithm.steps"] == 16}
    more = expanded(tmp_path, scores, **settings)
    assert [(row.cell["algorithm.steps"], row.trial) for row in more if row.seed == 0] == [
        *((8, trial) for trial in range(3)),
        *((16, trial) for trial in range(5)),
    ]
    partly = dict.fromkeys(list(scores)[1:], 1.0)
    assert expanded(tmp_path, partly, **settings) == rows


def test_a_wrong_point_of_a_search_is_refused_by_name(tmp_path: Path) -> None:
    space = {"algorithm.step": {"low": 8, "high": 16}}
    said = wrong(tmp_path, search={"space": space, "metric": METRIC, "trials": 3})
    assert "cell [algorithm.step=" in said
    assert "did you mean 'steps'?" in said


@pytest.mark.parametrize("sampler", ["random", "tpe"])
def test_a_search_may_choose_a_point_twice(tmp_path: Path, sampler: str) -> None:
    """With few choices it must; the run is then made once."""
    space = {"algorithm.steps": [8, 16]}
    search = {"space": space, "metric": METRIC, "trials": 6, "sampler": sampler}
    rows = expanded(tmp_path, search=search)
    assert len({row.id for row in rows}) == len(rows) == 2
    assert {row.cell["algorithm.steps"] for row in rows} == {8, 16}


# -------------------------------------------------------------------------------------------------------------- scores


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """A finished run."""
    wanted = replace(job(tmp_path_factory.mktemp("finished")), id="whole")
    perform(wanted)
    return wanted


@pytest.fixture
def pruned(finished: Job, tmp_path: Path) -> Job:
    """A run that has been pruned after its evaluations."""
    shutil.copytree(finished.path, tmp_path / "pruned")
    (tmp_path / "pruned" / "evaluation.json").unlink()
    values = json.loads((tmp_path / "pruned" / "status.json").read_text())
    (tmp_path / "pruned" / "status.json").write_text(json.dumps({**values, "state": "pruned"}))
    return replace(finished, path=tmp_path / "pruned", id="pruned")


def test_the_score_of_a_finished_run_is_that_of_its_final_evaluation(finished: Job) -> None:
    with (finished.path / "evaluation.csv").open(newline="") as file:
        written = {f"{row['policy']}/{row['metric']}": float(row["value"]) for row in csv.DictReader(file)}
    assert final_metrics(finished.path) == pytest.approx(written, nan_ok=True)
    for metric in (METRIC, "stochastic/return/distance"):
        assert read_scores([finished], metric) == {"whole": pytest.approx(written[metric])}


def test_the_score_of_a_pruned_run_is_that_of_its_last_evaluation(finished: Job, pruned: Job) -> None:
    with (pruned.path / "metrics.csv").open(newline="") as file:
        cells = [row[f"eval/{METRIC}"] for row in csv.DictReader(file)]
    last = [float(cell) for cell in cells if cell][-1]
    with (pruned.path / "metrics.csv").open("a") as file:
        file.write("99999" + "," * (len(file_columns(pruned)) - 1) + "\n")
    assert read_scores([finished, pruned], METRIC) == {
        "whole": final_metrics(finished.path)[METRIC],
        "pruned": pytest.approx(last),
    }


def file_columns(wanted: Job) -> list[str]:
    """The columns of a run's metrics.csv."""
    return (wanted.path / "metrics.csv").read_text().splitlines()[0].split(",")


@pytest.mark.parametrize("state", ["running", "trained", "interrupted", "failed", None])
def test_a_run_that_has_not_ended_has_no_score(pruned: Job, state: str | None) -> None:
    if state is None:
        (pruned.path / "status.json").unlink()
    else:
        (pruned.path / "status.json").write_text(json.dumps({"state": state, "step": 960}))
    assert read_scores([pruned], METRIC) == {}


def test_an_unknown_metric_is_refused_with_the_near_ones(finished: Job, pruned: Job) -> None:
    for wanted in (finished, pruned):
        with pytest.raises(ValueError, match="is not among those of the runs; did you mean") as error:
            read_scores([wanted], "greedy/utility_ers")
        assert METRIC in str(error.value)
