"""Learning curves: how runs are grouped, aligned and drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from algorithms.common.metrics_file import MetricsFile
from algorithms.common.yaml_io import dump
from algorithms.experiments.config import make_experiment
from algorithms.reporting.learning_curves import MAX_POINTS, curve, curve_panels, drawn, load_groups, plot
from algorithms.reporting.style import ALGORITHM_COLOURS, TRAINING
from tests.helpers.figures import curves, legend, saved_figures

Make = Callable[..., Path]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Make the directory of a run, with metrics."""

    def make(
        name: str,
        algorithm: str = "mo_a2c",
        seed: int = 0,
        points: int = 5,
        utility: str = "linear",
        **hyperparameters: Any,
    ) -> Path:
        values = {
            "environment": {"id": "mo-deepdrive-one-waypoint-v0"},
            "utility": {"name": f"one_waypoint_{utility}"},
            "algorithm": {"name": algorithm, **hyperparameters},
            "training": {"total_timesteps": 1000, "num_envs": 2, "seed": seed},
        }
        path = tmp_path / name
        path.mkdir()
        (path / "config.yaml").write_text(dump(make_experiment(values).to_dict()))
        metrics = MetricsFile(path / "metrics.csv")
        for step in range(points):
            metrics.write(10 * step, {"train/utility": step + seed, "train/return/jerk": -float(step)})
            metrics.write(10 * step, {"eval/greedy/utility_esr": step + seed, "eval/greedy/success": 0.5})
        return path

    return make


def test_runs_that_differ_in_their_seed_alone_are_one_group(make: Make) -> None:
    runs = [make("a", seed=0), make("b", seed=1), make("c", "a2c", seed=0), make("d", seed=2, gamma=0.9)]
    groups = load_groups(runs)
    assert [len(group.runs) for group in groups] == [1, 2, 1]
    assert [group.label for group in groups] == ["a2c, gamma 0.99", "mo_a2c, gamma 0.99", "mo_a2c, gamma 0.9"]


@pytest.mark.slow
def test_two_vehicles_have_separate_panels_and_one_for_both(make: Make) -> None:
    run = make("a")
    names = ["success", *(f"vehicle_{v}/{name}" for v in (0, 1) for name in ("success", "return/lane_violation"))]
    metrics = MetricsFile(run / "metrics.csv")
    for step in range(3):
        metrics.write(step, {"train/vehicle_0/utility": 1.0, "train/vehicle_1/utility": 2.0})
        metrics.write(step, {f"eval/greedy/{name}": 0.5 for name in names})
    titles = [panel.title for panel in curve_panels(load_groups([run]))]
    assert titles[-1] == "All vehicles: arrival rate"
    for vehicle in ("Vehicle 0", "Vehicle 1"):
        mine = [title for title in titles if title.startswith(vehicle)]
        panels = ["utility per episode", "arrival rate", "lane violation (sum, m)"]
        assert mine == [f"{vehicle}: {panel}" for panel in panels]
    plot(load_groups([run]), run / "curves.png")


def test_algorithms_are_labelled_by_their_names(make: Make) -> None:
    groups = load_groups([make("a"), make("b", "a2c", steps=4)])
    assert [group.label for group in groups] == ["a2c", "mo_a2c"]


def test_an_algorithm_has_one_colour_alone_and_beside_others(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = saved_figures(monkeypatch)
    mo_a2c, a2c = make("a"), make("b", "a2c")
    plot(load_groups([mo_a2c, a2c]), tmp_path / "both.png")
    plot(load_groups([a2c]), tmp_path / "alone.png")
    both, alone = found
    orange, blue = ALGORITHM_COLOURS["a2c"], ALGORITHM_COLOURS["mo_a2c"]
    assert list(legend(both).items())[:2] == [("a2c", orange), ("mo_a2c", blue)]
    assert curves(both.axes[0]) == [(orange, "-"), (blue, "-")]
    assert curves(alone.axes[0]) == [(TRAINING, "-"), (orange, "-")]
    assert legend(alone) == {"training": TRAINING, "evaluation, greedy": orange}


def test_what_cannot_be_drawn_is_refused(make: Make, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is not a run directory"):
        load_groups([tmp_path])
    with pytest.raises(ValueError, match="has no metrics yet"):
        load_groups([make("empty", points=0)])
    with pytest.raises(ValueError, match="the same seed, 0"):
        load_groups([make("a"), make("b")])
    with pytest.raises(ValueError, match="xyz"):
        plot(load_groups([make("c")]), tmp_path / "curves.xyz")


def test_a_curve_is_the_mean_within_its_interval() -> None:
    steps = np.arange(5.0)
    runs = [{"step": steps, "a": steps + offset} for offset in (-1.0, 0.0, 1.0)]
    found = curve(runs, "a")
    assert found is not None
    grid, mean, low, high = found
    np.testing.assert_array_equal(grid, steps)
    np.testing.assert_allclose(mean, steps)
    assert (low < mean).all()
    assert (mean < high).all()


def test_runs_of_different_length_are_compared_up_to_the_shortest() -> None:
    runs = [
        {"step": np.array([0.0, 10.0, 20.0]), "a": np.zeros(3)},
        {"step": np.array([0.0, 5.0, 15.0]), "a": np.ones(3)},
    ]
    found = curve(runs, "a")
    assert found is not None
    np.testing.assert_array_equal(found[0], [0.0, 10.0])


def test_rows_without_a_value_are_skipped_and_long_curves_averaged() -> None:
    steps = np.arange(1000.0)
    values = np.where(steps % 2 == 0, steps, np.nan)
    found = curve([{"step": steps, "a": values}], "a")
    assert found is not None
    assert len(found[0]) == MAX_POINTS
    np.testing.assert_allclose(found[0], found[1])
    assert np.isnan(found[2]).all()
    assert curve([{"step": steps, "a": np.full(1000, np.nan)}], "a") is None
    assert curve([{"step": steps}], "a") is None


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_figures_are_drawn_of_one_group_and_of_several(make: Make, tmp_path: Path, count: int) -> None:
    runs = [make("a", seed=0), make("b", seed=1), make("c", "a2c")][: count + 1]
    plot(load_groups(runs), tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_scores_that_cannot_be_compared_have_separate_panels(make: Make) -> None:
    groups = load_groups([make("a"), make("b", utility="nonlinear"), make("c", "a2c")])
    panels = {panel.title: panel.groups for panel in curve_panels(groups)}
    assert panels == {
        "Utility: one_waypoint_linear": (0, 1),
        "Utility: one_waypoint_nonlinear": (2,),
        "Arrival rate": (0, 1, 2),
        "Jerk (sum, m/s³)": (0, 1, 2),
    }


def test_metrics_that_are_drawn_can_be_selected(make: Make) -> None:
    (group,) = load_groups([make("a")])
    names = ["step", "eval/greedy/success", "loss/policy", "train/utility", "eval/greedy/max_jerk"]
    assert drawn(names, group.config) == ["eval/greedy/success", "train/utility"]


def test_axes_show_noise_as_noise_and_cut_off_the_start_where_it_would_flatten_the_rest(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = saved_figures(monkeypatch)
    (group,) = load_groups([make("a")])
    columns = {
        "step": np.arange(50.0),
        "eval/greedy/utility_esr": np.linspace(24.31, 24.35, 50),
        "eval/greedy/success": np.linspace(0.998, 1.0, 50),
        "eval/greedy/return/lane_violation": np.linspace(-1e-3, 0.0, 50),
        "eval/greedy/return/jerk": np.where(np.arange(50) < 2, -1e5, -100.0),
    }
    plot([replace(group, runs=(columns,))], tmp_path / "curves.png")
    titles = [axis.get_title(loc="left") for axis in found[0].axes]
    assert titles == [
        *("Utility per episode", "Arrival rate", "Jerk (sum, m/s³) (start cut off)", "Lane violation (sum, m)"),
    ]
    utility, success, jerk, lane = (axis.get_ylim() for axis in found[0].axes)
    assert np.ptp(utility) > 2.4
    assert np.ptp(success) > 1.0
    assert jerk == pytest.approx((-125.0, -75.0))
    assert np.ptp(lane) == pytest.approx(1.0)


def test_a_return_that_is_the_arrival_rate_has_no_panel_beside_it(make: Make) -> None:
    (group,) = load_groups([make("a")])

    def titles(*names: str) -> list[str]:
        columns = {name: np.zeros(3) for name in ("step", *names)}
        return [panel.title for panel in curve_panels([replace(group, runs=(columns,))])]

    rates = ("train/success", "train/return/destination", "eval/greedy/success", "eval/greedy/return/destination")
    assert titles(*rates, "eval/greedy/return/jerk") == ["Arrival rate", "Jerk (sum, m/s³)"]
    assert titles("eval/front/return/destination") == ["Destination"], "of fronts there is no arrival rate"
