"""Learning curves: how runs are grouped, aligned and drawn; scores against keys: what is binned, and which axes fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from algorithms.reporting import curves
from algorithms.reporting.curves import (
    CurveGroup,
    VariedScores,
    curve,
    curve_panels,
    load_groups,
    parts_of_key,
    plot,
    plot_effects,
    score_limits,
)
from algorithms.reporting.run_records import experiment_record
from algorithms.reporting.style import ALGORITHM_COLOURS, MAX_POINTS, MINIMUM_SPAN
from algorithms.reporting.training_log import MetricsFile
from algorithms.runs.config import make_experiment
from mo_deepdrive.support.yaml import dump

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
    assert [group.label for group in groups] == ["a2c", "mo_a2c algorithm.gamma=0.99", "mo_a2c algorithm.gamma=0.9"]


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


def made_up(
    algorithm: str, *runs: Any, name: str = "eval/greedy/utility_esr", env_id: str = "mo-deepdrive-one-waypoint-v0"
) -> CurveGroup:
    """A group with a run per sequence of values."""
    config = {
        "environment": {"id": env_id},
        "algorithm": {"name": algorithm},
        "training": {"seed": 0},
    }
    columns = tuple({"step": np.arange(len(run), dtype=np.float64), name: np.asarray(run, float)} for run in runs)
    return CurveGroup(algorithm, experiment_record(config), columns)


def panel(*groups: CurveGroup) -> Axes:
    """The only panel of the groups."""
    (wanted,) = curve_panels(groups)
    axis = Figure().subplots()
    curves._draw_panel(axis, groups, wanted)
    return axis


def test_curves_have_the_colours_of_their_algorithms_alone_and_together() -> None:
    a2c, mo_a2c = (made_up(name, [1.0, 2.0], [2.0, 3.0]) for name in ("a2c", "mo_a2c"))
    for groups in ((a2c,), (mo_a2c,), (a2c, mo_a2c), (mo_a2c, a2c)):
        colours = [to_hex(line.get_color()).upper() for line in panel(*groups).lines]
        assert colours == [ALGORITHM_COLOURS[group.label] for group in groups]


def test_an_axis_does_not_magnify_noise() -> None:
    low, high = panel(made_up("a2c", [9.250, 9.252, 9.249, 9.251, 9.250])).get_ylim()
    assert high - low >= MINIMUM_SPAN * 9.25
    name = "eval/greedy/return/jerk"
    low, high = panel(made_up("a2c", [-1.0, -0.5, -0.7], name=name)).get_ylim()
    assert high - low >= MINIMUM_SPAN * 500.0, "of the nominal scale"
    low, high = panel(made_up("a2c", [0.0, 50.0, 100.0])).get_ylim()
    assert (low, high) == pytest.approx((-5.0, 105.0)), "what differs fills the axis"


def test_two_seeds_get_no_band_and_the_figure_says_so() -> None:
    two, three = made_up("a2c", [1.0, 2.0], [2.0, 3.0]), made_up("mo_a2c", [1.0, 2.0], [2.0, 3.0], [3.0, 4.0])
    assert not panel(two).collections
    assert len(panel(two, three).collections) == 1
    figure = Figure()
    curves._frame(figure, [two, three], "")
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()][:2] == ["a2c (n = 2)", "mo_a2c"]
    figure = Figure()
    curves._frame(figure, [two], "")
    assert "2 seeds, too few for an interval (n = 2)" in " ".join(figure.artists[0].get_text().split())


def test_our_destination_is_not_drawn_beside_the_arrival_rate() -> None:
    name = "eval/greedy/return/destination"
    assert not curve_panels([made_up("a2c", [1.0], name=name)])
    (panel,) = curve_panels([made_up("a2c", [1.0], name=name, env_id="another-v0")])
    assert panel.title == "Destination"


def test_scores_under_other_arguments_have_separate_panels_that_name_them() -> None:
    def group(algorithm: str, size: int = 8, weight: int = 1, gamma: float = 0.99, split: str = "test") -> CurveGroup:
        config = {
            "environment": {"id": "theirs-v0", "arguments": {"size": size}},
            "utility": {"name": "linear", "arguments": {"weights": [weight, 1]}, "vehicles": {}},
            "algorithm": {"name": algorithm},
            "training": {"seed": 0},
            "evaluation": {"gamma": gamma, "reference_point": None, "split": split},
        }
        return CurveGroup(algorithm, experiment_record(config), made_up(algorithm, [1.0]).runs)

    def panels(other: CurveGroup) -> dict[str, tuple[int, ...]]:
        return {panel.title: panel.groups for panel in curve_panels([group("ppo"), other])}

    assert panels(group("mo_ppo")) == {"Utility per episode": (0, 1)}
    assert panels(group("mo_ppo", weight=9)) == {
        "Utility: utility.arguments.weights=[1, 1]": (0,),
        "Utility: utility.arguments.weights=[9, 1]": (1,),
    }
    assert panels(group("mo_ppo", size=9)) == {
        "Utility: environment.arguments.size=8": (0,),
        "Utility: environment.arguments.size=9": (1,),
    }
    assert panels(group("mo_ppo", gamma=1.0)) == {
        "Utility: evaluation.gamma=0.99": (0,),
        "Utility: evaluation.gamma=1.0": (1,),
    }
    assert panels(group("mo_ppo", split="validation")) == {"Utility per episode": (0, 1)}, "of the final scores alone"


def test_runs_with_one_vehicle_are_drawn_beside_runs_with_two() -> None:
    names = {
        "a2c": ["utility_esr", "success"],
        "mo_a2c": ["success", *(f"vehicle_{v}/{name}" for v in (0, 1) for name in ("utility_esr", "success"))],
    }
    groups = []
    for algorithm, metrics in names.items():
        columns = {f"eval/greedy/{name}": np.ones(1) for name in metrics}
        groups.append(CurveGroup(algorithm, made_up(algorithm).experiment, ({"step": np.zeros(1), **columns},)))
    assert [(panel.title, panel.groups) for panel in curve_panels(groups)] == [
        ("Utility per episode", (0,)),
        ("Arrival rate", (0,)),
        ("Vehicle 0: utility per episode", (1,)),
        ("Vehicle 0: arrival rate", (1,)),
        ("Vehicle 1: utility per episode", (1,)),
        ("Vehicle 1: arrival rate", (1,)),
        ("All vehicles: arrival rate", (1,)),
    ]


# -------------------------------------------------------------------------------------------- scores against keys


def test_every_value_has_a_mean_and_many_values_are_binned() -> None:
    labels, positions, parts = parts_of_key(np.repeat([8.0, 32.0, 16.0], 20))
    assert labels == ["8", "16", "32"]
    np.testing.assert_array_equal(positions, np.repeat([0, 2, 1], 20))
    assert [part[0] for part in parts] == [0, 40, 20]
    labels, _, parts = parts_of_key(np.linspace(0.9, 1.0, 60))
    assert not labels
    assert [len(part) for part in parts] == [8, 8, 8, 8, 7, 7, 7, 7]
    labels, positions, _ = parts_of_key(["b", "a rather long word, in fact", "b"])
    assert labels == ["b", "a rather long wor…"]
    assert positions.tolist() == [0, 1, 0]


def test_a_few_outliers_do_not_flatten_the_other_runs() -> None:
    scores = np.linspace(0.0, 1.0, 100)
    assert score_limits(scores) == pytest.approx((-0.06, 1.06))
    scores[-1] = -1e6
    low, high = score_limits(scores)
    assert -0.5 < low < 0.0
    assert 0.9 < high < 1.5
    scores[-20:] = -1e6  # no longer a few
    assert score_limits(scores)[0] < -1e6


def test_scores_are_not_magnified() -> None:
    low, high = score_limits(np.array([10.0, 10.001, 10.002, 10.003, 10.0]))
    assert high - low >= 1.0


def test_scores_are_drawn_against_what_was_varied(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rates, names = 10.0 ** rng.uniform(-4, -2, 40), ["one", "another, rather long", "a third, even longer"] * 20
    keys: dict[str, Any] = {"rate": rates, "name": names[:40], "steps": np.repeat([8.0, 16.0], 20)}
    first = VariedScores(
        "environment, utility [1]", "greedy utility", rng.normal(size=40), ("a2c", "mo_a2c") * 20, keys
    )
    second = VariedScores(
        "another",
        "$hypervolume_",
        np.full(40, 3.0),
        ("pcn",) * 40,
        {f"{key}_{i}": keys[key] for key in keys for i in "ab"},
    )
    plot_effects([first, second], tmp_path / "scores.png", "title", "a remark")
    assert (tmp_path / "scores.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="xyz"):
        plot_effects([first], tmp_path / "scores.xyz", "title")
