"""Evaluations that are printed, saved as the results of a run, and loaded again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from algorithms.commands import plot, table
from algorithms.reporting.run_records import experiment_record
from algorithms.reporting.tables import group_runs
from algorithms.runs.config import make_experiment
from mo_deepdrive.evaluation import Evaluation, evaluate
from mo_deepdrive.utilities import make_utility

ONE_WAYPOINT = "mo-deepdrive-one-waypoint-v0"
INTERSECTION = "mo-deepdrive-intersection-v0"
SHORT = {"time_limit": 2.0}


def hold(observations: Any, _accrued: Any, _discounts: Any) -> Any:
    return np.full(observations.shape[:-1], 3)


def made(env_id: str = ONE_WAYPOINT, utility: Any = "one_waypoint_linear", **options: Any) -> Evaluation:
    return evaluate(hold, env_id, utility=utility, **{"episodes": 4, "split": "test", "env_kwargs": SHORT, **options})


def gini(objectives: int) -> dict[str, Any]:
    return {"weights": np.linspace(1.0, 0.2, objectives), "scales": {"jerk": 10.0}}


def test_an_evaluation_is_printed_in_a_few_lines() -> None:
    first, second = repr(made()).splitlines()
    assert first == f"Evaluation: 4 episodes of the test split of {ONE_WAYPOINT}, 1 vehicle"
    assert second.startswith("  success 0; utility_esr ")
    assert "(one_waypoint_linear); mean returns distance " in second
    lines = str(made(INTERSECTION, "intersection_linear", split=None, seed=5)).splitlines()
    assert [line.split()[0] for line in lines] == ["Evaluation:", "together:", "vehicle_0:", "vehicle_1:"]
    assert "4 episodes from seed 5 of" in lines[0]


@pytest.mark.parametrize(
    ("env_id", "utility", "arguments"),
    [
        (ONE_WAYPOINT, "one_waypoint_linear", SHORT),
        (ONE_WAYPOINT, None, {**SHORT, "objectives": ["jerk", "distance", "destination", "g_force"]}),
        (ONE_WAYPOINT, "generalised_gini", SHORT),
        (INTERSECTION, ["intersection_linear", "intersection_nonlinear"], SHORT),
        ("deep-sea-treasure-v0", None, {"max_episode_steps": 9}),
    ],
)
def test_a_saved_evaluation_is_loaded_as_it_was(
    tmp_path: Path, env_id: str, utility: Any, arguments: dict[str, Any]
) -> None:
    if utility == "generalised_gini":
        utility = make_utility(utility, ("distance", "destination", "g_force", "jerk"), **gini(4))
    found = made(env_id, utility, env_kwargs=arguments)
    found.save(tmp_path / "new" / "saved", name="hold", seed=0)
    loaded = Evaluation.load(tmp_path / "new" / "saved")
    for name, value in vars(found).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(loaded, name), value, err_msg=name)
    assert (loaded.objectives, loaded.provenance) == (found.objectives, found.provenance)
    assert loaded.estimates() == found.estimates()
    with np.load(tmp_path / "new" / "saved" / "episodes.npz", allow_pickle=False) as file:
        assert set(file) > {"returns", "ends"}


def test_a_utility_that_is_a_function_is_given_again(tmp_path: Path) -> None:
    def one_waypoint_linear(returns: Any) -> Any:  # not ours, in spite of its name
        return returns[..., 0]

    found = made(utility=one_waypoint_linear)
    found.save(tmp_path / "saved", name="hold", seed=0)
    with pytest.raises(ValueError, match=r"'one_waypoint_linear' cannot be loaded: it is a function .* utilities="):
        Evaluation.load(tmp_path / "saved")
    assert Evaluation.load(tmp_path / "saved", utilities=found.utilities).metrics() == found.metrics()


def test_saved_evaluations_are_compared_with_runs_of_the_same_task(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("hold", "other"):
        for seed in range(3):
            made(gamma=np.float64(0.9)).save(tmp_path / f"{name}-{seed}", name=name, seed=seed, steps=1000)
    assert table.main([str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "other - hold" in printed
    assert plot.main([str(tmp_path), "--output", str(tmp_path / "curves.png")]) == 0
    groups = group_runs([tmp_path], print)
    experiment = make_experiment(
        {
            "environment": {"id": ONE_WAYPOINT, "arguments": SHORT},
            "utility": {"name": "one_waypoint_linear"},
            "algorithm": {"name": "a2c"},
            "training": {"total_timesteps": 1000, "num_envs": 1},
            "evaluation": {"gamma": 0.9},
        }
    ).to_dict()
    assert {group.measured for group in groups} == {f"{experiment_record(experiment).task_key} test"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": ""}, "name = '' must be the label of the algorithm"),
        ({"seed": -1}, "seed = -1 must be an integer of at least 0"),
        ({"steps": -1}, "steps = -1 must be"),
        ({"directory": "."}, "'.' exists; choose another"),
    ],
)
def test_what_cannot_be_saved_is_refused(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"directory": tmp_path / "saved", "name": "hold", "seed": 0, **options}
    with pytest.raises(ValueError, match=message):
        made().save(**arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [None, b"", b"PK", "objects"], ids=["missing", "empty", "cut", "pickled"])
def test_files_that_are_no_evaluation_are_refused(tmp_path: Path, content: Any) -> None:
    path = tmp_path / "episodes.npz"
    if content == "objects":
        np.savez(path, about=np.array([{}], dtype=object))
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"episodes\.npz"):
        Evaluation.load(tmp_path)


def test_arrays_that_do_not_fit_together_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "saved" / "episodes.npz"
    made().save(tmp_path / "saved", name="hold", seed=0)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **{**arrays, "lengths": arrays["lengths"][:-1]})
    with pytest.raises(ValueError, match="its arrays do not fit together: lengths has the shape"):
        Evaluation.load(tmp_path / "saved")
