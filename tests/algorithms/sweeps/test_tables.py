"""Metrics by which the table of a sweep can be sorted; the tables themselves are tested with their collection."""

from __future__ import annotations

import polars as pl
import pytest

from algorithms.sweeps.tables import check_metric

SCORES = pl.DataFrame(
    [("greedy", "", "success"), ("greedy", "vehicle_0", "utility_esr"), ("front", "", "hypervolume")],
    ["policy", "vehicle", "metric"],
    orient="row",
)


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
        ("policy/kl", "metric 'policy/kl' was renamed; write 'policy/approx_kl'"),
        ("front/success", "is not among those of the runs"),
    ],
)
def test_other_metrics_are_refused(metric: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_metric(metric, SCORES)
