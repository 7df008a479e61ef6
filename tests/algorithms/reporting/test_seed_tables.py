"""Tables over seeds: which runs share a row, and what the row is called; the command line is tested with the script."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from algorithms.reporting.run_records import EnvironmentRecord, UtilityRecord, label_of
from algorithms.reporting.tables import (
    TABLE_METRICS,
    comparison_table,
    find_runs,
    group_runs,
    print_runs,
    scores_table,
    tidy_scores,
    without_empty_columns,
)
from algorithms.runs.config import make_experiment
from mo_deepdrive.evaluation.evaluation import Evaluation
from mo_deepdrive.support.yaml import dump, read_mapping

ONE, TWO = "mo-deepdrive-one-waypoint-v0", "mo-deepdrive-intersection-v0"


def make_run(path: Path, seed: int, algorithm: str = "mo_a2c", **training: Any) -> None:
    values = {
        "environment": {"id": ONE},
        "utility": {"name": "one_waypoint_linear"},
        "algorithm": {"name": algorithm},
        "training": {"total_timesteps": 1000, "num_envs": 2, "seed": seed},
    }
    config = make_experiment(values).to_dict()
    config["training"] |= training
    path.mkdir()
    (path / "config.yaml").write_text(dump(config))
    policies = {"greedy": {"success": {"value": 0.1 * seed, "low": None, "high": None}}}
    (path / "evaluation.json").write_text(json.dumps({"policies": policies}))


def test_runs_on_another_device_or_with_more_threads_share_a_row(tmp_path: Path) -> None:
    make_run(tmp_path / "a", 0)
    make_run(tmp_path / "b", 1, device="cuda:7")
    make_run(tmp_path / "c", 2, threads=4)
    make_run(tmp_path / "d", 0, num_envs=4)
    first, second = group_runs([tmp_path], pytest.fail)
    assert (first.seeds, second.seeds) == ([0, 1, 2], [0])
    assert first.scores["greedy", "", "success"] == pytest.approx([0.0, 0.1, 0.2])  # type: ignore[index]


def test_rows_of_one_algorithm_name_the_settings_that_differ(tmp_path: Path) -> None:
    make_run(tmp_path / "a", 0)
    make_run(tmp_path / "b", 1)
    make_run(tmp_path / "c", 0, num_envs=4)
    make_run(tmp_path / "d", 0, "ppo")
    header, *rows = scores_table(group_runs([tmp_path], pytest.fail))
    told = [row[header.index("settings")] for row in rows]
    assert told == ["training.num_envs=2", "training.num_envs=4", ""]


def test_a_csv_has_the_returns_of_all_objectives_and_the_terminal_has_not(tmp_path: Path) -> None:
    make_run(tmp_path / "run", 0)
    values = {"success": 0.5, "return/energy": -3.0, "return/jerk": -2.0, "max_jerk": 4.0}
    scores = {name: {"value": value, "low": None, "high": None} for name, value in values.items()}
    (tmp_path / "run/evaluation.json").write_text(json.dumps({"policies": {"greedy": scores}}))
    groups = group_runs([tmp_path], pytest.fail)
    header, row = scores_table(groups)
    assert header[-3:] == ["success", "return/energy", "return/jerk"]
    assert [float(cell) for cell in row[-3:]] == [0.5, -3.0, -2.0]
    assert scores_table(groups, TABLE_METRICS)[0][-1] == "success"


def test_algorithms_are_in_the_order_of_figures_and_compared_with_the_ones_before(tmp_path: Path) -> None:
    for name in ("mo_ppo", "ppo", "mo_a2c", "a2c"):
        for seed in range(2):
            path = tmp_path / f"{name}-{seed}"
            make_run(path, seed, name)
            scores = {"utility_esr": {"value": 1.0 + seed, "low": None, "high": None}}
            (path / "evaluation.json").write_text(json.dumps({"policies": {"greedy": scores}}))
    groups = group_runs([tmp_path], pytest.fail)
    assert [group.algorithm for group in groups] == ["a2c", "mo_a2c", "ppo", "mo_ppo"]
    pairs = [row[3] for row in comparison_table(groups)[1:]]
    assert pairs == [
        *("mo_a2c - a2c", "ppo - a2c", "mo_ppo - a2c"),
        *("ppo - mo_a2c", "mo_ppo - mo_a2c", "mo_ppo - ppo"),
    ]


def make_pair(folder: Path, ppo: dict[str, Any], mo_ppo: dict[str, Any]) -> None:
    """Two runs of PPO and two of MO-PPO, with final utilities, whose configs have other keys as given."""
    for name, sections in (("ppo", ppo), ("mo_ppo", mo_ppo)):
        for seed in range(2):
            path = folder / f"{name}-{seed}"
            make_run(path, seed, name)
            config = read_mapping(path / "config.yaml")
            for section, values in sections.items():
                config[section] |= values
            (path / "config.yaml").write_text(dump(config))
            scores = {"utility_esr": {"value": 1.0 + seed, "low": None, "high": None}}
            (path / "evaluation.json").write_text(json.dumps({"policies": {"greedy": scores}}))


@pytest.mark.parametrize(
    ("ppo", "mo_ppo", "column", "labels"),
    [
        (
            {"utility": {"arguments": {"weights": [100, 1, 0, 0]}}},
            {"utility": {"arguments": {"weights": [1, 1, 0, 0]}}},
            "utility",
            ["one_waypoint_linear weights=[1, 1, 0, 0]", "one_waypoint_linear weights=[100, 1, 0, 0]"],
        ),
        (
            {"environment": {"id": "theirs-v0", "arguments": {"size": 8, "wind": 1}}},
            {"environment": {"id": "theirs-v0", "arguments": {"size": 9, "wind": 1}}},
            "environment",
            ["theirs-v0 size=8", "theirs-v0 size=9"],
        ),
        ({"evaluation": {"split": "validation"}}, {"evaluation": {"split": "test"}}, "environment", [ONE, ONE]),
    ],
)
def test_runs_of_different_tasks_are_not_compared(
    tmp_path: Path, ppo: dict[str, Any], mo_ppo: dict[str, Any], column: str, labels: list[str]
) -> None:
    make_pair(tmp_path, ppo, mo_ppo)
    groups = group_runs([tmp_path], pytest.fail)
    assert [group.task[column] for group in groups] == labels
    assert len(comparison_table(groups)) == 1


def test_a_comparison_after_different_numbers_of_steps_says_so(tmp_path: Path) -> None:
    make_pair(tmp_path, {"training": {"total_timesteps": 5000}}, {})
    header, row = comparison_table(group_runs([tmp_path], pytest.fail))
    found = dict(zip(header, row, strict=True))
    assert (found["difference"], found["steps"]) == ("mo_ppo - ppo", "1000 against 5000")


def test_where_only_some_seeds_have_arrivals_the_others_have_none(tmp_path: Path) -> None:
    # Another library's environment whose episodes have no info["end"]: only a success tells that it reports them.
    for seed in range(5):
        make_run(tmp_path / str(seed), seed)
        evaluation = Evaluation(
            objectives=("distance",),
            utilities=(),
            returns=np.zeros((10, 1, 1)),
            discounted=np.zeros((10, 1, 1)),
            lengths=np.ones((10, 1), dtype=np.int64),
            succeeded=np.full((10, 1), seed == 3),
            ends=np.full((10, 1), None),
            largest=np.zeros((10, 1, 1)),
        )
        scores = {name: asdict(estimate) for name, estimate in evaluation.estimates().items()}
        (tmp_path / str(seed) / "evaluation.json").write_text(json.dumps({"policies": {"greedy": scores}}))
    header, row = scores_table(group_runs([tmp_path], pytest.fail))
    assert float(dict(zip(header, row, strict=True))["success"].split()[0]) == pytest.approx(0.2)


def test_files_below_a_run_are_no_runs(tmp_path: Path) -> None:
    make_run(tmp_path / "run", 0)
    of_wandb = tmp_path / "run/wandb/run-1/files"
    of_wandb.mkdir(parents=True)
    (of_wandb / "config.yaml").write_text("_wandb: {}")
    assert find_runs([tmp_path], pytest.fail) == find_runs([tmp_path / "run"], pytest.fail) == [tmp_path / "run"]


def test_scores_have_the_digits_that_the_episodes_of_one_run_support(tmp_path: Path) -> None:
    for seed in range(3):
        make_run(tmp_path / str(seed), seed)
        utility = 10.0 + 0.001 * seed
        scores = {"utility_esr": {"value": utility, "low": utility - 0.6, "high": utility + 0.6}}
        (tmp_path / str(seed) / "evaluation.json").write_text(json.dumps({"policies": {"greedy": scores}}))
    (group,) = group_runs([tmp_path], pytest.fail)
    header, row = scores_table([group])
    assert dict(zip(header, row, strict=True))["utility_esr"] == "10.0 [10.0, 10.0]"
    group.widths.clear()
    assert dict(zip(header, scores_table([group])[1], strict=True))["utility_esr"] == "10.0010 [10.0000, 10.0020]"


def test_environments_are_named_by_their_id_and_the_arguments_that_differ_from_the_default() -> None:
    arguments = make_experiment(
        {
            "environment": {"id": TWO, "arguments": {"end_together": True, "time_limit": 30}},
            "utility": {"name": "intersection_linear"},
            "algorithm": {"name": "mo_a2c"},
            "training": {"total_timesteps": 1000, "num_envs": 2},
        }
    ).to_dict()["environment"]["arguments"]
    for env_id, given, label in (
        (TWO, arguments, f"{TWO} time_limit=30.0 end_together=True"),
        ("deep-sea-treasure-v0", {"float_state": True}, "deep-sea-treasure-v0"),
        ("some.module:unknown-v0", {}, "some.module:unknown-v0"),
    ):
        assert label_of(EnvironmentRecord(id=env_id, arguments=given)) == label


def test_utilities_are_named_with_those_of_other_vehicles() -> None:
    assert label_of(None) == ""
    assert label_of(UtilityRecord(name="linear")) == "linear"
    other = UtilityRecord(name="linear", vehicles={"vehicle_1": UtilityRecord(name="owa")})
    assert label_of(other) == "linear vehicle_1=owa"


def test_columns_without_numbers_are_dropped() -> None:
    assert without_empty_columns([["a", "b"], ["1", ""], ["2", ""]]) == [["a"], ["1"], ["2"]]


@pytest.mark.parametrize(
    ("objective", "rate", "shown"), [("jerk", 0.0, False), ("jerk", 0.5, True), ("collision", 0.0, True)]
)
def test_collisions_have_a_column_where_there_is_something_to_collide_with(
    tmp_path: Path, objective: str, rate: float, shown: bool
) -> None:
    make_run(tmp_path / "run", 0)
    metrics = {"success": 0.5, "end/collision": rate, f"return/{objective}": 0.0}
    scores = {name: {"value": value, "low": None, "high": None} for name, value in metrics.items()}
    (tmp_path / "run/evaluation.json").write_text(json.dumps({"policies": {"greedy": scores}}))
    header, _ = scores_table(group_runs([tmp_path], pytest.fail))
    assert ("end/collision" in header) is shown


@pytest.mark.parametrize(("seeds", "noted"), [(1, False), (2, True), (3, False)])
def test_two_seeds_have_no_interval_and_the_table_says_so(tmp_path: Path, seeds: int, noted: bool) -> None:
    for algorithm in ("a2c", "mo_a2c"):
        for seed in range(seeds):
            path = tmp_path / f"{algorithm}{seed}"
            make_run(path, seed, algorithm)
            scores = {"utility_esr": {"value": 1.0 + seed, "low": None, "high": None}}
            (path / "evaluation.json").write_text(json.dumps({"policies": {"greedy": scores}}))
    console = Console(width=200, record=True)
    groups = print_runs([tmp_path], console, pytest.fail)
    text = console.export_text()
    assert ("Fewer than 3 seeds have no interval." in text) is noted
    assert ("(with three seeds: from the lowest to the highest)" in text) is (seeds == 3)
    header, row, *_ = tidy_scores(groups)
    ends = [row[header.index(name)] for name in ("mean", "low", "high", "n")]
    assert ends == ([2.0, 1.0, 3.0, 3] if seeds == 3 else [0.5 + 0.5 * seeds, None, None, seeds])
    if noted:
        header, row = comparison_table(groups)
        assert dict(zip(header, row, strict=True))["p"] == "1.000"
