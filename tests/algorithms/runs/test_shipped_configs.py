"""Shipped YAML files are found by name; a file that exists wins."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from algorithms.runs.config import CONFIGS, config_names, find_config, load_experiment
from algorithms.studies.plan import StudyPlan
from algorithms.studies.settings import load_study, load_sweep


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_every_yaml_file_of_the_repository_has_a_name(repository: Path) -> None:
    assert repository / "configs" == CONFIGS
    assert len(config_names()) == len(list((repository / "configs").rglob("*.yaml"))) > 50
    assert {"studies/paper", "one_waypoint/mo_ppo_nonlinear", "peers/envelope", "sweeps/one_waypoint"} <= {
        *config_names()
    }
    for name in config_names():
        if not {"sweeps", "studies", "suite"} & {*Path(name).parts}:
            load_experiment(name)


@pytest.mark.parametrize("name", ["one_waypoint/pcn", "one_waypoint/pcn.yaml", "configs/one_waypoint/pcn.yaml"])
def test_a_shipped_file_is_found_by_its_name_or_its_path_in_a_checkout(name: str) -> None:
    assert find_config(name) == CONFIGS / "one_waypoint" / "pcn.yaml"
    assert load_experiment(name).algorithm.name == "pcn"


def test_a_file_wins_over_a_shipped_one_but_a_folder_does_not(tmp_path: Path) -> None:
    (tmp_path / "one_waypoint" / "pcn").mkdir(parents=True)
    assert find_config("one_waypoint/pcn") == CONFIGS / "one_waypoint" / "pcn.yaml"
    own = tmp_path / "one_waypoint" / "pcn.yaml"
    own.write_text("")
    assert find_config("one_waypoint/pcn.yaml").resolve() == own
    with pytest.raises(ValueError, match="cannot be read"):
        load_experiment("one_waypoint")


def test_a_file_may_lie_beside_the_one_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "base.yaml").write_text("")
    assert find_config("base.yaml", beside=tmp_path / "mine" / "sweep.yaml") == tmp_path / "mine" / "base.yaml"
    (tmp_path / "base.yaml").write_text("")
    assert find_config("base.yaml", beside=tmp_path / "mine" / "sweep.yaml").resolve() == tmp_path / "base.yaml"


@pytest.mark.parametrize("load", [find_config, load_experiment, load_sweep])
def test_an_unknown_name_is_refused_with_the_nearest(load: Callable[[str], Any]) -> None:
    message = (
        "config file 'one_waypoint/mo_ppo_nonlinea' does not exist; the nearest names of shipped ones: "
        "one_waypoint/mo_ppo_nonlinear, one_waypoint/ppo_nonlinear, one_waypoint/mo_ppo_linear$"
    )
    with pytest.raises(ValueError, match=message):
        load("one_waypoint/mo_ppo_nonlinea")
    with pytest.raises(ValueError, match=r"'\.\./secrets\.yaml' does not exist"):
        load("../secrets.yaml")


@pytest.mark.parametrize("name", ["sweeps/one_waypoint", "sweeps/load", "sweeps/search"])
def test_shipped_sweeps_name_shipped_experiments(name: str) -> None:
    assert all(find_config(config).is_file() for config in load_sweep(name).config)


@pytest.mark.parametrize("name", [name for name in config_names() if name.startswith("studies/")])
def test_in_shipped_studies_everything_has_an_effect(name: str) -> None:
    plan = StudyPlan(load_study(name))
    assert plan.arms
    assert plan.idle == []
