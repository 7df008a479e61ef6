"""Names of metrics, and the summary of episodes against sums taken in plain Python."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mo_deepdrive.evaluation import metrics
from mo_deepdrive.evaluation.metrics import (
    APPROX_KL,
    end_rates,
    known_metric,
    label,
    lower_is_better,
    split_name,
    summarise,
)
from mo_deepdrive.simulation.state import ENDS

OBJECTIVES = ("distance", "g_force")

# Names.


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("success", ("", "", "success")),
        ("greedy/success", ("greedy", "", "success")),
        ("vehicle_0/end/collision", ("", "vehicle_0", "end/collision")),
        ("front/hypervolume", ("front", "", "hypervolume")),
        ("eval/stochastic/vehicle_1/return/jerk", ("stochastic", "vehicle_1", "return/jerk")),
        ("train/vehicle_0/utility", ("", "vehicle_0", "utility")),
        ("train/return/jerk", ("", "", "return/jerk")),
        ("policy/approx_kl", ("", "", "policy/approx_kl")),
        ("vehicle_1/loss/value", ("", "vehicle_1", "loss/value")),
    ],
)
def test_names_are_split_into_policy_vehicle_and_metric(name: str, parts: tuple[str, str, str]) -> None:
    assert split_name(name) == parts


def test_an_unknown_name_is_refused_with_the_nearest_one() -> None:
    with pytest.raises(ValueError, match=r"'policy/aprox_kl' .* did you mean 'policy/approx_kl'\?"):
        known_metric("policy/aprox_kl", [APPROX_KL, "success"])


@pytest.mark.parametrize(
    ("name", "lower"),
    [
        ("front/hypervolume", False),
        ("eval/front/igd_plus", True),
        ("greedy/vehicle_0/length", True),
        ("max_jerk", True),
        ("mean_g_force", True),
        ("return/jerk", False),
        ("end/collision", True),
        ("end/arrived", False),
        ("loss/value", True),
    ],
)
def test_some_metrics_are_better_when_lower(name: str, lower: bool) -> None:
    assert lower_is_better(name) is lower


def test_labels_say_what_is_summed() -> None:
    assert metrics.label("vehicle_1/g_force") == "vehicle 1: g-force (sum, g)"
    assert metrics.label("vehicle_1/of_another_library") == "vehicle_1/of_another_library"
    assert metrics.label("other/jerk") == "other/jerk"
    assert label("jerk") == "jerk (sum, m/s³)"
    assert label("g_force", "discounted") == "g-force (discounted, g)"
    assert label("destination") == "destination"
    assert label("objective_0") == "objective_0"


# Summaries.


def episodes(count: int, seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return {
        "returns": rng.normal(size=(count, 2)) * (10.0, 3.0),
        "lengths": rng.integers(1, 60, count),
        "succeeded": rng.random(count) < 0.4,
    }


def utility(returns: Any) -> Any:
    return returns[..., 0] - returns[..., 1] ** 2


@pytest.mark.parametrize("count", [1, 7, 200])
def test_a_summary_of_training_has_means_and_the_mean_utility(count: int) -> None:
    given = episodes(count)
    summary = summarise(OBJECTIVES, **given, utility=utility)
    assert list(summary) == ["utility", "success", "length", "return/distance", "return/g_force"]
    rows = given["returns"].tolist()
    assert summary["utility"] == pytest.approx(sum(a - b**2 for a, b in rows) / count)
    assert summary["success"] == pytest.approx(sum(given["succeeded"].tolist()) / count)
    assert summary["length"] == pytest.approx(sum(given["lengths"].tolist()) / count)
    assert summary["return/distance"] == pytest.approx(sum(a for a, _ in rows) / count)
    assert summary["return/g_force"] == pytest.approx(sum(b for _, b in rows) / count)
    assert all(type(value) is float for value in summary.values())


def test_training_logs_keep_their_sums_to_the_last_bit() -> None:
    given = episodes(257)
    expected = given["returns"].mean(axis=0)
    found = summarise(OBJECTIVES, **given)
    assert [found[f"return/{objective}"] for objective in OBJECTIVES] == expected.tolist()
    # The same episodes in one array of success, length and returns, as algorithms that learn a front collect them.
    table = np.stack([np.array([s, n, *r]) for r, n, s in zip(*given.values(), strict=True)])
    columns = np.mean(list(table), axis=0)
    again = summarise(OBJECTIVES, table[:, 2:], table[:, 1], table[:, 0])
    assert list(again.values()) == columns.tolist()


def test_reasons_that_did_not_occur_are_0_where_all_are_known() -> None:
    ends = np.array(["arrived", "collision", "arrived", "arrived"], dtype=object)
    rates = end_rates(ends)
    assert set(rates) == set(ENDS) - {""}
    assert {reason: rate for reason, rate in rates.items() if rate} == {"arrived": 0.75, "collision": 0.25}
    assert end_rates(np.array([None, None], dtype=object)) == {}
    others = np.array(["arrived", "sank"], dtype=object)  # of another environment
    assert end_rates(others) == {"arrived": 0.5, "sank": 0.5}
