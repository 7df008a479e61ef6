"""Final evaluations: every metric with its interval, and the files that are written."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from algorithms.reporting.tables import evaluation_table
from mo_deepdrive.evaluation.evaluation import Evaluation
from mo_deepdrive.evaluation.evaluation_files import write_evaluation
from mo_deepdrive.evaluation.statistics import Estimate
from mo_deepdrive.utilities import Utility, make_utility

OBJECTIVES = ("distance", "jerk")


def square(returns: Any) -> Any:
    return returns[..., 0] ** 2


def shown(evaluations: dict[str, Evaluation]) -> list[str]:
    """The names of the rows of a table."""
    return list(evaluation_table(evaluations, "a title").columns[0].cells)


def test_ends_that_occurred_have_a_row_with_the_rate_of_every_policy() -> None:
    held, other = evaluation(), evaluation()
    assert [name for name in shown({"greedy": held}) if name.startswith("end/")] == ["end/circling"]
    assert {"end/collision", "end/off_lane", "end/time_limit"} <= set(held.estimates()), "the files have them"
    held.ends[0], other.ends[:] = "harmful_jerk", "time_limit"
    table = evaluation_table({"greedy": held, "stochastic": other}, "a title")
    names, *columns = (list(column.cells) for column in table.columns)
    cells = {name: texts for name, *texts in zip(names, *columns, strict=True) if name.startswith("end/")}
    assert list(cells) == ["end/time_limit", "end/circling", "end/harmful_jerk"]
    never, always = r"0.000 \[0.000, 0.071]", r"1.000 \[0.929, 1.000]"
    assert cells["end/time_limit"] == [never, always]
    assert cells["end/harmful_jerk"][1] == never
    assert table.caption == "success: the share of arrivals; other ends (end/...) that no episode had are left out."
    without = evaluation(ends=False)
    table = evaluation_table({"greedy": held, "stochastic": without}, "a title")
    assert list(table.columns[2].cells)[names.index("end/circling") - 1] == "", "it is not known"
    assert evaluation_table({"greedy": without}, "a title").caption is None


def test_rows_that_repeat_others_are_not_shown() -> None:
    held = evaluation()
    assert "utility_ser" in shown({"greedy": held})
    held.objectives = ("destination", "collision")
    held.returns[..., 0] = held.succeeded
    held.utilities = (make_utility("linear", held.objectives, weights=[1.0, 0.01]),)
    rows = shown({"greedy": held, "stochastic": held})
    assert not {"return/destination", "utility_ser", "discounted_utility_ser"} & set(rows)


def evaluation(episodes: int = 50, vehicles: int = 1, ends: bool = True) -> Evaluation:
    generator = np.random.default_rng(1)
    shape = (episodes, vehicles)
    returns = generator.normal([3.0, -100.0], [1.0, 20.0], (*shape, 2))
    return Evaluation(
        objectives=OBJECTIVES,
        utilities=(Utility("square", OBJECTIVES, square),) * vehicles,
        returns=returns,
        discounted=0.5 * returns,
        lengths=np.full(shape, 10),
        succeeded=np.arange(episodes * vehicles).reshape(shape) % 4 == 0 if ends else np.zeros(shape, dtype=np.bool_),
        ends=np.full(shape, "circling" if ends else None, dtype=object),
        largest=np.abs(returns),
    )


def test_estimates_have_the_values_of_the_metrics() -> None:
    held = evaluation()
    summary = held.estimates()
    metrics = held.metrics()
    for name in (
        "utility_esr",
        "utility_ser",
        "discounted_utility_esr",
        "success",
        "length",
        "return/jerk",
        "mean_jerk",
    ):
        assert summary[name].value == pytest.approx(metrics[name]), name
    assert summary["end/circling"].value == 1.0
    assert summary["end/collision"].value == 0.0
    assert summary["max_jerk"] == Estimate(held.largest[..., 1].max())
    assert "mean_distance" not in summary


def test_esr_and_ser_agree_for_a_linear_utility() -> None:
    held = evaluation()
    held.utilities = (make_utility("linear", OBJECTIVES, weights=[1.0, 0.01]),)
    summary = held.estimates()
    assert summary["utility_esr"].value == pytest.approx(summary["utility_ser"].value)


def test_an_environment_that_does_not_say_why_episodes_end_gets_no_rates() -> None:
    summary = evaluation(ends=False).estimates()
    assert "success" not in summary
    assert not [name for name in summary if name.startswith("end/")]


def test_every_vehicle_has_its_own_metrics() -> None:
    names = set(evaluation(vehicles=2).estimates())
    assert {"vehicle_0/utility_esr", "vehicle_1/utility_esr", "vehicle_1/end/circling"} <= names


def test_success_and_collisions_of_all_vehicles_are_counted_per_episode() -> None:
    found = evaluation(episodes=4, vehicles=2)
    found.succeeded[:] = [[True, True], [True, False], [False, True], [False, False]]
    found.ends[:] = [["arrived", "arrived"], ["arrived", "collision"], ["collision", "arrived"], ["collision"] * 2]
    summary = found.estimates()
    assert summary["success"].value == 0.25
    assert summary["end/collision"].value == 0.75
    assert summary["vehicle_1/end/collision"].value == 0.5
    assert "success" in evaluation().estimates()
    assert {"utility_esr", "length"}.isdisjoint(summary)


def test_every_metric_is_written_and_shown(tmp_path: Path) -> None:
    policies = {"greedy": evaluation(5), "stochastic": evaluation(5, ends=False)}
    write_evaluation(tmp_path, policies, {"seed": 7, "episodes": 5})
    stored = json.loads((tmp_path / "evaluation.json").read_text())
    expected = policies["greedy"].estimates()["utility_esr"]
    assert stored["seed"] == 7
    assert stored["policies"]["greedy"]["utility_esr"] == {
        "value": expected.value,
        "low": expected.low,
        "high": expected.high,
    }
    with (tmp_path / "evaluation.csv").open() as file:
        rows = {(row["policy"], row["metric"]): row for row in csv.DictReader(file)}
    assert float(rows["greedy", "utility_esr"]["value"]) == expected.value
    assert rows["greedy", "max_jerk"]["low"] == ""
    with (tmp_path / "episodes.csv").open() as file:
        episodes = list(csv.DictReader(file))
    assert [int(row["seed"]) for row in episodes] == [7, 8, 9, 10, 11] * 2
    assert float(episodes[2]["return/jerk"]) == policies["greedy"].returns[2, 0, 1]
    console = Console(width=120, record=True)
    console.print(evaluation_table(policies, "a [title]"))
    text = console.export_text()
    assert "end/circling" in text
    assert expected.text() in text


@pytest.mark.parametrize("width", [60, 80, 100])
def test_a_table_with_two_vehicles_and_long_names_fits_the_terminal(width: int) -> None:
    held = evaluation(vehicles=2)
    held.objectives = ("distance", "minus_the_energy_drawn_from_the_battery_in_kilowatt_hours")
    console = Console(width=width, record=True)
    console.print(evaluation_table({"greedy": held, "stochastic": held}, "a title"))
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= width
    assert not any("…" in line for line in lines)
    text = "".join("".join(lines).split())
    for name, estimate in held.estimates().items() if width >= 80 else ():
        assert "".join(estimate.text().split()) in text, name
