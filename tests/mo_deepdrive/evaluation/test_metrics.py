"""Which metrics are better when lower, and the summary of episodes against sums taken in plain Python."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mo_deepdrive.evaluation.metrics import (
    APPROX_KL,
    end_rates,
    known_metric,
    lower_is_better,
    summarise,
)
from mo_deepdrive.simulation.state import ENDS

OBJECTIVES = ("distance", "g_force")

# Names.


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


def test_reasons_that_did_not_occur_are_0_where_all_are_known() -> None:
    ends = np.array(["arrived", "collision", "arrived", "arrived"], dtype=object)
    rates = end_rates(ends)
    assert set(rates) == set(ENDS) - {""}
    assert {reason: rate for reason, rate in rates.items() if rate} == {"arrived": 0.75, "collision": 0.25}
    assert end_rates(np.array([None, None], dtype=object)) == {}
    others = np.array(["arrived", "sank"], dtype=object)  # of another environment
    assert end_rates(others) == {"arrived": 0.5, "sank": 0.5}
