"""Cells are ranked among those that are comparable, by metrics that the runs have, and have readable labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl
import pytest

from algorithms.studies.sweep_collection import collect
from algorithms.studies.sweep_ranking import (
    cell_labels,
    check_metric,
    rank,
    short_names,
    totals,
    value_labels,
    varying_keys,
)
from tests.helpers.made_up_sweeps import config_of, end, make_row, make_sweep, scores_of

SCORES = pl.DataFrame(
    [("greedy", "", "success"), ("greedy", "vehicle_0", "utility_esr"), ("front", "", "hypervolume")],
    ["policy", "vehicle", "metric"],
    orient="row",
)


def test_cells_are_ranked_among_comparable_cells(tmp_path: Path, base: dict[str, Any]) -> None:
    other = config_of("one_waypoint/mo_a2c_nonlinear")
    front = config_of("one_waypoint/pcn")
    cells = [{"config": name, "algorithm.learning_rate": rate} for name in "abc" for rate in (1e-4, 1e-2, 1e-3)]
    rows = [
        make_row({"a": base, "b": other, "c": front}[cell["config"]], cell, seed) for cell in cells for seed in (0, 1)
    ]
    make_sweep(tmp_path, rows)
    for row in rows[12:]:
        end(tmp_path, row, {"front": {"hypervolume": 100.0 - scores_of(row), "igd_plus": 1.0 - scores_of(row)}})
    collection = collect(tmp_path)
    scores = collection.scores.collect()
    rankings = rank(collection.cells, scores)
    names = [
        "mo-deepdrive-one-waypoint-v0, one_waypoint_linear",
        "mo-deepdrive-one-waypoint-v0, one_waypoint_nonlinear",
        "mo-deepdrive-one-waypoint-v0 fixed_destination=True",
    ]
    assert [(each.title, each.score_name) for each in rankings] == list(
        zip(names, ["greedy utility", "greedy utility", "front hypervolume"], strict=True)
    )
    rates = [[cell.keys["algorithm.learning_rate"] for cell in each.ranked] for each in rankings]
    assert rates == [[1e-2, 1e-3, 1e-4], [1e-2, 1e-3, 1e-4], [1e-4, 1e-3, 1e-2]]
    assert rankings[0].score(rankings[0].cells[0]) == pytest.approx(10.05)
    by_collisions = rank(collection.cells, scores, "end/collision")  # the fewer the better
    assert [len(each.ranked) for each in by_collisions] == [3, 3, 0]
    assert [cell.keys["algorithm.learning_rate"] for cell in by_collisions[0].ranked] == [1e-2, 1e-3, 1e-4]
    assert rank(collection.cells, scores, "front/igd_plus")[2].ranked[0].keys["algorithm.learning_rate"] == 1e-2
    with pytest.raises(ValueError, match=r"'greedy/sucess' is not among .* did you mean 'greedy/success'"):
        rank(collection.cells, scores, "greedy/sucess")


@pytest.mark.parametrize(
    ("metric", "best"), [("end/arrived", 16), ("end/collision", 8), ("length", 8), ("success", 16)]
)
def test_the_best_cell_has_the_highest_score_unless_lower_is_better(
    tmp_path: Path, base: dict[str, Any], metric: str, best: int
) -> None:
    rows = make_sweep(tmp_path, [make_row(base, {"algorithm.steps": steps}, 0) for steps in (8, 16)])
    for row in rows:
        end(tmp_path, row, {"greedy": {metric: row.config["algorithm"]["steps"] / 16}})
    collection = collect(tmp_path)
    (ranking,) = rank(collection.cells, collection.scores.collect(), metric)
    assert ranking.ranked[0].keys == {"algorithm.steps": best}


def test_utilities_are_summed_over_vehicles(tmp_path: Path) -> None:
    base = config_of("intersection/mo_a2c_linear")
    rows = [make_row(base, {"algorithm.steps": steps}, 0) for steps in (8, 16)]
    make_sweep(tmp_path, rows)
    for row, (first, second) in zip(rows, ((1.0, 5.0), (3.0, 2.0)), strict=True):
        numbers = {"success": 0.5, "vehicle_0/utility_esr": first, "vehicle_1/utility_esr": second}
        end(tmp_path, row, {"greedy": numbers})
    collection = collect(tmp_path)
    (both,) = rank(collection.cells, collection.scores.collect())
    assert both.score_name == "greedy total utility"
    assert [both.score(cell) for cell in both.cells] == [6.0, 5.0]
    (one,) = rank(collection.cells, collection.scores.collect(), "greedy/vehicle_0/utility_esr")
    assert [one.score(cell) for cell in one.cells] == [3.0, 1.0]


def test_cells_of_different_splits_are_not_ranked_together(tmp_path: Path, base: dict[str, Any]) -> None:
    make_sweep(tmp_path, [make_row(base, {"evaluation.split": split}, 0) for split in ("validation", "test")])
    collection = collect(tmp_path)
    assert [len(each.cells) for each in rank(collection.cells, collection.scores.collect())] == [1, 1]


def test_rankings_with_equal_titles_also_show_their_keys(tmp_path: Path, base: dict[str, Any]) -> None:
    cells = [{"evaluation.gamma": gamma, "algorithm.steps": steps} for gamma in (0.9, 1.0) for steps in (8, 16)]
    make_sweep(tmp_path, [make_row(base, cell, 0) for cell in cells])
    collection = collect(tmp_path)
    titles = [ranking.title for ranking in rank(collection.cells, collection.scores.collect())]
    assert [title.rpartition(" (")[2] for title in titles] == ["evaluation.gamma=0.9)", "evaluation.gamma=1.0)"]


def test_a_key_is_shortened_unless_another_one_ends_in_the_same_way() -> None:
    keys = ["algorithm.steps", "environment.steps", "algorithm.gamma"]
    assert short_names(keys) == {**{key: key for key in keys[:2]}, "algorithm.gamma": "gamma"}


def test_totals_are_sums_over_the_vehicles_alone() -> None:
    rows = [
        ("a", "greedy", vehicle, "m", value) for vehicle, value in (("", 9.0), ("vehicle_0", 1.0), ("vehicle_1", 2.0))
    ]
    found = totals(pl.DataFrame(rows, ["run", "policy", "vehicle", "metric", "value"], orient="row"))
    assert found["value"].to_list() == [3.0]


def test_cells_have_short_names(base: dict[str, Any], tmp_path: Path) -> None:
    utilities = [{"name": "a", "arguments": {"x": x}} for x in (1, 2)]
    assert value_labels([utilities[0], utilities[0]]) == ["a", "a"]
    assert value_labels(utilities)[0] == '{"arguments": {"x": 1}, "name": "a"}'
    cells = [{"config": "c", "algorithm.steps": steps, "training.num_envs": 4} for steps in (8, 16)]
    make_sweep(tmp_path, [make_row(base, cell, 0) for cell in cells])
    found = collect(tmp_path).cells
    assert varying_keys(cells) == ["algorithm.steps"]
    assert cell_labels(found, ["config", "algorithm.steps"]) == ["c, steps 8", "c, steps 16"]
    assert cell_labels(found[:1], []) == ["mo_a2c"]


@pytest.mark.parametrize(
    "metric",
    ["greedy/success", "success", "greedy/vehicle_0/utility_esr", "vehicle_0/utility_esr", "greedy/utility_esr"],
)
def test_policy_and_vehicle_may_be_omitted(metric: str) -> None:
    check_metric(metric, SCORES)


@pytest.mark.parametrize(
    ("metric", "message"),
    [
        ("greedy/sucess", "did you mean 'greedy/success'"),
        ("front/success", "is not among those of the runs"),
    ],
)
def test_other_metrics_are_refused(metric: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_metric(metric, SCORES)
