"""``scripts/conditioned_preferences.py``: how well one network serves preferences that are drawn anew."""

from __future__ import annotations

import csv
import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from algorithms import zoo
from algorithms.common.yaml_io import dump, read_mapping, read_value
from algorithms.experiments.build import build, load_policy
from algorithms.experiments.config import make_experiment
from algorithms.experiments.run_directory import Run
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.evaluation.splits import SPLITS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType

NAME = "one_waypoint_drawn_front-conditioned_mo_ppo"


@pytest.fixture
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("conditioned_preferences")


def test_own_and_best_are_the_expected_utilities(script: ModuleType) -> None:
    served = script.Served(
        components=("weight/a", "weight/b"),
        preferences=np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]),
        utilities=np.array([[2.0, 4.0, 0.0], [0.0, 1.0, 3.0], [1.0, 2.5, 1.5]]),
        objectives=("a", "b"),
        returns=np.zeros((3, 2)),
        discounted=np.zeros((3, 2)),
        success=np.array([1.0, 0.5, 0.0]),
        lengths=np.ones(3),
    )
    assert served.own.tolist() == [2.0, 1.0, 1.5]
    assert served.best.tolist() == [4.0, 3.0, 2.5]
    low, high = served.thirds(0)
    assert (low.tolist(), high.tolist()) == ([False, True, False], [True, False, False])


def test_a_network_of_the_zoo_serves_preferences_that_it_is_given(
    script: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run.open(NAME)
    (served,) = script.serve(run, 12, 4, SPLITS["validation"].start)
    np.testing.assert_allclose(served.preferences.sum(axis=1), 1.0, rtol=1e-6)
    scaled = served.discounted / load_policy(run).scales
    np.testing.assert_allclose(served.utilities, served.preferences @ scaled.T, atol=1e-6)
    assert 0.0 < served.own.mean() <= served.best.mean()
    assert served.success.max() == 1.0
    low, high = served.thirds(0)  # the distance
    assert served.returns[high, 0].mean() > served.returns[low, 0].mean()
    script.main([NAME, "--preferences", "12", "--episodes", "4"])
    assert f"{served.own.mean():.3f}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("env_id", "family", "vehicles"),
    [
        ("mo-deepdrive-one-waypoint-v0", "{families: {comfort_budget: 1.0}, budgets: {jerk: 100.0}}", 1),
        ("mo-deepdrive-intersection-v0", "{families: {linear: 1.0}}", 2),
    ],
)
def test_budgets_and_two_vehicles_are_served_too(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], env_id: str, family: str, vehicles: int
) -> None:
    experiment = make_experiment(
        {
            "environment": {"id": env_id, "arguments": {"time_limit": 2}},
            "algorithm": {"name": "conditioned_mo_ppo", "hidden": [8], **read_value(family)},
            "training": {"total_timesteps": 256, "num_envs": 8},
        }
    )
    run = Run.create(experiment, tmp_path / "run")
    run.unlock()
    agent = build(experiment)
    agent.train(256)
    agent.save(run.checkpoint)
    found = script.serve(run, 6, 3, SPLITS["validation"].start)
    assert len(found) == vehicles
    for v, served in enumerate(found):
        k = int(served.utilities[2].argmax())
        drives = agent.evaluate_policies(
            np.concatenate([each.preferences for each in found], axis=1)[[k]],
            make_env(env_id, 3, {"time_limit": 2}),
            episodes=3,
            seed=SPLITS["validation"].start,
            gamma=0.99,
        )
        returns = torch.from_numpy(drives[0].discounted[:, v])
        expected = agent.preferences.utility(returns, torch.from_numpy(served.preferences[2]).float()).mean()
        assert served.utilities[2, k] == pytest.approx(float(expected))
    file = tmp_path / "preferences.csv"
    script.main([str(run.path), "--preferences", "6", "--episodes", "3", "--output", str(file)])
    out = capsys.readouterr().out
    with file.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert len(rows) == vehicles * (1 + 2 * len(found[0].components))
    for v, served in enumerate(found):
        everything, low, *_ = (row for row in rows if row["vehicle"] == str(v))
        assert float(everything["own"]) == pytest.approx(served.own.mean(), abs=1e-4)
        objective = served.objectives.index(low["component"].partition("/")[2])
        expected = served.returns[served.thirds(0)[0], objective].mean()
        assert float(low["undiscounted"]) == pytest.approx(expected, rel=1e-3)
    assert ("budget/jerk" in out, "vehicle_1" in out) == (vehicles == 1, vehicles == 2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["one_waypoint_front-pcn"], "must be a run of conditioned_mo_ppo for one family of utilities"),
        ([NAME, "--episodes", "0"], "--episodes 0 must be at least 1"),
        ([NAME, "--episodes", "1000000000"], "--episodes = 1000000000 exceeds the "),
        ([NAME, "--preferences", "0"], "--preferences 0 must be between 1 and 10000"),
        ([NAME, "--preferences", "100000000000"], "--preferences 100000000000 must be between 1 and 10000"),
    ],
)
def test_invalid_arguments_are_refused(
    script: ModuleType, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        script.main(arguments)
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_run_that_names_code_needs_trust(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own_code.py").write_text("from algorithms import ConditionedMOPPO as Own\n")
    monkeypatch.syspath_prepend(tmp_path)
    values = read_mapping(zoo.find(NAME) / "config.yaml")
    values["algorithm"]["name"] = "own_code:Own"
    shutil.copytree(zoo.find(NAME), tmp_path / "run")
    (tmp_path / "run" / "config.yaml").write_text(dump(values))
    with pytest.raises(SystemExit):
        script.main([str(tmp_path / "run"), "--preferences", "2", "--episodes", "1"])
    assert "'own_code:Own', code that would be imported and run; add --trust" in capsys.readouterr().err
    script.main([str(tmp_path / "run"), "--preferences", "2", "--episodes", "1", "--trust"])
    assert "arrivals" in capsys.readouterr().out
