"""Intervals of means, rates and utilities; comparisons of runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mo_deepdrive.evaluation.statistics import (
    Estimate,
    Resampled,
    bootstrap,
    holm,
    iqm,
    iqm_difference,
    mann_whitney_p,
    mean,
    mean_difference,
    of_mean,
    probability_of_improvement,
    rate,
    shares,
    spread_ratio,
)


def square(returns: Any) -> Any:
    return returns[..., 0] ** 2


def interval(found: Estimate) -> tuple[float, float]:
    assert found.low is not None
    assert found.high is not None
    return found.low, found.high


def test_bootstrap_intervals_cover_the_mean_as_often_as_they_should() -> None:
    samples = np.random.default_rng(0).normal(5.0, 2.0, (40, 1000))
    low, high = bootstrap(samples)
    assert 0.91 <= np.mean((low <= 5.0) & (high >= 5.0)) <= 0.97
    again = bootstrap(samples)
    np.testing.assert_array_equal(low, again[0])


def test_one_sample_has_a_value_and_no_interval() -> None:
    assert mean(np.array([2.0])) == Estimate(2.0)
    assert of_mean(np.array([[3.0, 1.0]]), square) == Estimate(9.0)
    assert np.isnan(bootstrap(np.ones((1, 3)))[0]).all()


def test_rates_of_0_and_1_have_an_interval() -> None:
    none = rate(np.zeros(100, dtype=np.bool_))
    assert (none.value, none.low) == (0.0, 0.0)
    assert none.high == pytest.approx(0.037, abs=1e-3)
    assert rate(np.ones(100, dtype=np.bool_)).high == 1.0


def test_the_utility_of_the_mean_lies_in_its_interval_and_bootstraps_episodes() -> None:
    returns = np.random.default_rng(0).normal(3.0, 1.0, (200, 1))
    found = of_mean(returns, square)
    assert found.value == pytest.approx(returns.mean() ** 2)
    low, high = interval(found)
    assert low < found.value < high
    assert high - low == pytest.approx(2 * 1.96 * 2 * 3.0 / np.sqrt(200), rel=0.15)


@pytest.mark.parametrize(
    ("estimate", "text"),
    [
        (Estimate(1.23456), "1.235"),
        (Estimate(9.7112, 9.5012, 9.9012), "9.71 [9.50, 9.90]"),
        (Estimate(-123.4, -150.0, -100.0), "-123 [-150, -100]"),
        (Estimate(0.0, 0.0, 0.0713), "0.000 [0.000, 0.071]"),
        (Estimate(5.0, 5.0, 5.0), "5"),
    ],
)
def test_estimates_are_formatted_to_the_digits_that_matter(estimate: Estimate, text: str) -> None:
    assert estimate.text() == text


def test_the_interquartile_mean_leaves_out_the_lowest_and_the_highest_quarter() -> None:
    assert iqm(np.array([-100.0, 1.0, 2.0, 3.0, 1000.0])).value == pytest.approx(2.0)
    assert iqm(np.array([0.0, 1.0, 3.0, 50.0])).value == pytest.approx(2.0)
    assert iqm(np.array([1.0, 2.0, 6.0])).value == pytest.approx(3.0)  # three runs have no quarter to lose


def test_a_single_run_has_no_interval() -> None:
    one, two = np.array([3.0]), np.array([1.0, 2.0])
    assert iqm(one) == Estimate(3.0)
    assert iqm_difference(one, two) == Estimate(1.5)
    assert probability_of_improvement(one, two) == Estimate(1.0)


def test_the_probability_of_improvement_counts_pairs_and_half_of_the_ties() -> None:
    first, second = np.array([1.0, 2.0, 5.0]), np.array([1.0, 3.0, 4.0])
    pairs = [1.0 if x > y else 0.5 if x == y else 0.0 for x in first for y in second]
    found = probability_of_improvement(first, second)
    assert found.value == pytest.approx(np.mean(pairs))
    assert probability_of_improvement(second, first).value == pytest.approx(1.0 - found.value)
    low, high = interval(found)
    assert 0.0 <= low <= found.value <= high <= 1.0


def test_the_difference_has_the_sign_of_the_first_and_an_interval_around_it() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.normal(5.0, 1.0, 10), rng.normal(3.0, 1.0, 8)
    found = iqm_difference(first, second)
    assert found.value == pytest.approx(iqm(first).value - iqm(second).value)
    low, high = interval(found)
    assert 0.0 < low < found.value < high
    back = iqm_difference(second, first)
    assert back.value == pytest.approx(-found.value)


def test_the_spread_ratio_is_that_of_the_standard_deviations() -> None:
    first, second = np.array([1.0, 2.0, 3.0, 4.0]), np.array([10.0, 20.0, 30.0, 40.0])
    found = spread_ratio(first, second)
    assert found.value == pytest.approx(0.1)
    assert interval(found)[0] < 0.1
    assert spread_ratio(second, first).value == pytest.approx(10.0)
    assert spread_ratio(first, np.ones(4)).value == np.inf
    assert spread_ratio(np.ones(4), np.ones(4)).value == 1.0
    for found in (spread_ratio(first, np.ones(4)), spread_ratio(first, np.array([1.0, 1.0, 1.0, 1.1]))):
        assert not np.isnan([found.value, found.low, found.high]).any()
        assert found.text()


def test_the_difference_of_equal_samples_is_zero_within_its_interval() -> None:
    sample = np.array([1.0, 2.0, 3.0, 4.0])
    found = mean_difference(sample, sample)
    assert found.value == 0.0
    low, high = interval(found)
    assert low < 0.0 < high
    assert mann_whitney_p(sample, sample) > 0.9


def over_seeds_and_scenarios(samples: Any, stream: str) -> Resampled:
    """The mean of samples (seeds, scenarios)."""
    drawn = shares(samples.shape[1])
    return Resampled.over_seeds([(seed.mean(), drawn @ seed) for seed in samples], stream)


def test_intervals_over_seeds_and_scenarios_cover_the_mean_of_all_of_both() -> None:
    generator, covered = np.random.default_rng(0), []
    for _ in range(200):
        seeds, scenarios = generator.normal(0.0, 0.2, (10, 1)), generator.normal(0.0, 1.0, (1, 64))
        samples = seeds + scenarios + generator.normal(0.0, 0.5, (10, 64))
        low, high = interval(over_seeds_and_scenarios(samples, "a").estimate)
        covered.append(low <= 0.0 <= high)
    assert 0.9 <= np.mean(covered) <= 0.99


def test_a_small_difference_on_the_same_scenarios_is_found_where_scenarios_differ_much() -> None:
    generator = np.random.default_rng(0)
    scenarios = generator.normal(0.0, 5.0, 100)
    first, second = (scenarios + mean + generator.normal(0.0, 0.1, (10, 100)) for mean in (0.0, 0.3))
    one, two = over_seeds_and_scenarios(first, "a"), over_seeds_and_scenarios(second, "b")
    assert interval(one.estimate)[1] > interval(two.estimate)[0]  # the intervals overlap by far
    difference = two - one
    assert interval(difference.estimate) == pytest.approx((0.3, 0.3), abs=0.05)
    assert difference.p < 0.01
    assert (one - one).p == 1.0


def test_two_seeds_have_no_interval_and_differ_from_nothing() -> None:
    few = over_seeds_and_scenarios(np.array([[1.0, 2.0, 3.0], [2.0, 3.0, 4.0]]), "a")
    many = over_seeds_and_scenarios(np.arange(12.0).reshape(4, 3), "b")
    assert few.estimate == Estimate(2.5)
    assert (few - many).p == Resampled.mean([few, many]).p == 1.0


def test_several_comparisons_need_smaller_p_values_as_holm_has_it() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []
