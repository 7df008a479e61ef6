"""Experiments: typed YAML, overrides, and errors that name the key, the value and what is allowed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from algorithms.experiment import load_experiment, make_experiment, parse_overrides
from algorithms.yaml_files import dump, read_mapping, read_value

TEXT = """
environment:
  id: mo-deepdrive-one-waypoint-v0
  arguments: {time_limit: 10}
utility:
  name: one_waypoint_linear
algorithm:
  name: mo_a2c
  learning_rate: 3e-4
training:
  total_timesteps: 1e5
  num_envs: 8
"""

Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def write(text: str) -> Path:
        path = tmp_path / "experiment.yaml"
        path.write_text(text)
        return path

    return write


def test_every_default_is_filled_in(write: Write) -> None:
    experiment = load_experiment(write(TEXT))
    assert experiment.training.total_timesteps == 100_000
    assert experiment.evaluation.interval == 5_000
    assert experiment.logging.checkpoint_interval == 5_000
    assert experiment.environment.arguments["time_limit"] == 10.0
    assert experiment.environment.arguments["decision_frequency"] == 10
    assert experiment.hyperparameters["learning_rate"] == 3e-4
    assert experiment.hyperparameters["gamma"] == 0.99


def test_a_vehicle_may_have_a_utility_of_its_own(write: Write) -> None:
    override = "--utility.vehicles.vehicle_1={name: linear, arguments: {weights: [1, 0, 0, 0]}}"
    utility = load_experiment(write(TEXT), [override]).utility
    assert utility.of_vehicle(0) is utility
    assert utility.of_vehicle(1).name == "linear"
    assert utility.of_vehicle(1).arguments == {"weights": [1, 0, 0, 0]}
    assert load_experiment(write(TEXT)).utility.of_vehicle(1).name == utility.name


def test_the_resolved_experiment_reloads_equal(write: Write, tmp_path: Path) -> None:
    overrides = ["--logging.wandb={project: p, tags: [a, '1e3']}", "--environment.arguments.objectives=[distance]"]
    experiment = load_experiment(write(TEXT), overrides)
    path = tmp_path / "resolved.yaml"
    path.write_text(dump(experiment.to_dict()))
    assert load_experiment(path) == experiment
    assert make_experiment(experiment.to_dict()) == experiment


def test_the_committed_configs_are_valid(repository: Path) -> None:
    configs = [path for path in sorted((repository / "configs").rglob("*.yaml")) if "sweeps" not in path.parts]
    assert configs
    for path in configs:
        load_experiment(path)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3e-4", 3e-4),
        ("1e6", 1e6),
        ("-2.5E+3", -2500.0),
        (".5", 0.5),
        ("1_000", 1000),
        ("7", 7),
        ("true", True),
        ("None", None),
        ("null", None),
        ("[1, 2e-1]", [1, 0.2]),
        ("{'a': 1}", {"a": 1}),
        ("'3e-4'", "3e-4"),
        ("e5", "e5"),
    ],
)
def test_values_are_read_as_people_and_sweep_agents_write_them(text: str, value: Any) -> None:
    found = read_value(text)
    assert found == value
    assert type(found) is type(value)


def test_overrides_take_every_form() -> None:
    arguments = ["--algorithm.learning_rate=3e-4", "--seed", "3", "--device=cpu", "--environment.arguments.a", "-1"]
    assert parse_overrides(arguments) == [
        ("algorithm.learning_rate", 3e-4),
        ("training.seed", 3),
        ("training.device", "cpu"),
        ("environment.arguments.a", -1),
    ]


def test_overrides_change_the_experiment_and_the_last_one_counts(write: Write) -> None:
    overrides = ["--algorithm.gamma=1", "--seed=3", "--algorithm={'steps': 4, 'hidden': [8]}", "--training.seed=4"]
    experiment = load_experiment(write(TEXT), overrides)
    assert experiment.training.seed == 4
    assert experiment.hyperparameters["gamma"] == 1.0
    assert experiment.hyperparameters["steps"] == 4
    assert experiment.hyperparameters["hidden"] == [8]
    assert experiment.hyperparameters["learning_rate"] == 3e-4


@pytest.mark.parametrize(
    ("override", "messages"),
    [
        ("--algorithm.learning_rat=1", ["learning_rat", "did you mean 'learning_rate'"]),
        ("--algoritm.gamma=1", ["algoritm", "did you mean 'algorithm'"]),
        ("--training.sed=1", ["training.sed", "did you mean 'seed'"]),
        ("--environment.arguments.time_limi=1", ["time_limi", "did you mean 'time_limit'"]),
        ("--environment.arguments.scenario=intersection", ["scenario", "set by the id"]),
        ("--environment.id=mo-deepdrive-one-waypont-v0", ["did you mean 'mo-deepdrive-one-waypoint-v0'"]),
        ("--environment.id=no_such_module:x-v0", ["no_such_module", "cannot import"]),
        ("--algorithm.name=mo_a2d", ["mo_a2d", "did you mean 'mo_a2c'"]),
        ("--algorithm.name=[1]", ["algorithm.name", "known: a2c, mo_a2c"]),
        ("--algorithm.gamma=2", ["'gamma' = 2", "less than or equal to 1"]),
        ("--algorithm.learning_rate=fast", ["'learning_rate' = 'fast'", "number"]),
        ("--algorithm.learning_rate=.nan", ["learning_rate", "finite"]),
        ("--training.total_timesteps=0", ["training.total_timesteps", "greater than or equal to 1"]),
        ("--training.total_timesteps=1.5", ["training.total_timesteps", "1.5", "integer"]),
        ("--training.num_envs=many", ["training.num_envs", "'many'", "integer"]),
        ("--training.seed=-1", ["training.seed", "greater than or equal to 0"]),
        ("--training.seed=true", ["training.seed", "True", "integer"]),
        ("--training.device=abacus", ["training.device", "abacus", "cpu, cuda"]),
        ("--training.device=cuda:99", ["training.device", "cuda:99", "not there"]),
        ("--evaluation.gamma=1.1", ["evaluation.gamma", "less than or equal to 1"]),
        ("--utility=linear", ["utility", "'linear'"]),
        ("--logging.wandb.projct=x", ["projct", "did you mean 'project'"]),
        ("--utility.vehicles.vehicle_1.nam=x", ["utility.vehicles.vehicle_1.nam", "did you mean 'name'"]),
        ("--utility.vehicles.vehicle_1={arguments: {}}", ["utility.vehicles.vehicle_1.name", "missing"]),
        ("--utility.vehicles=[a, b]", ["utility.vehicles", "dictionary"]),
        ("--training.seed.x.y=1", ["training.seed"]),
    ],
)
def test_what_is_wrong_is_named_with_what_is_allowed(write: Write, override: str, messages: list[str]) -> None:
    path = write(TEXT + "  seed: 1\n")
    with pytest.raises(ValueError) as caught:  # noqa: PT011  (the message is looked at below)
        load_experiment(path, [override])
    for message in messages:
        assert message in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["seed=3"], "'seed=3' is not of the form"),
        (["--"], "is not of the form"),
        (["--a..b=1"], "is not of the form"),
        (["--seed"], "has no value"),
        (["--seed", "--device=cpu"], "has no value"),
        (["--algorithm=[1,"], "--algorithm: '[1,' is not a valid value"),
    ],
)
def test_arguments_of_another_form_are_refused(arguments: list[str], message: str) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        parse_overrides(arguments)
    assert message in str(caught.value)


def test_several_problems_are_named_at_once(write: Write) -> None:
    with pytest.raises(ValueError, match=r"time_limi.*learning_rat.*abacus"):
        load_experiment(
            write(TEXT), ["--environment.arguments.time_limi=1", "--algorithm.learning_rat=1", "--device=abacus"]
        )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("- a\n- b\n", "holds a list"),
        ("1: 2\n", "holds a dict"),
        ("a: [1\n", "is not valid YAML"),
        ("a: 1\nb: 2\na: 3\n", "'a' stands twice, in lines 1 and 3"),
        ("training: {seed: 1, seed: 2}\n", "'seed' stands twice"),
        ("!!python/object/apply:os.getcwd []\n", "is not valid YAML"),
        ("algorithm: {learning_rate: 1}\n", "'environment' is missing"),
    ],
)
def test_broken_files_are_refused_by_name(write: Write, text: str, message: str) -> None:
    path = write(text)
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        load_experiment(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)


def test_missing_and_unreadable_files_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"nowhere\.yaml' does not exist"):
        load_experiment(tmp_path / "nowhere.yaml")
    with pytest.raises(ValueError, match="cannot be read"):
        load_experiment(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="cannot be read"):
        load_experiment(tmp_path / "binary.yaml")


def test_a_written_mapping_reads_back_equal(tmp_path: Path) -> None:
    values = {"a": "3e-4", "b": 3e-4, "c": [1, 2.5, "1e3"], "d": {"e": None, "f": {}}, "g": 1e22, "h": "yes", "i": "é"}
    path = tmp_path / "values.yaml"
    path.write_text(dump(values))
    assert read_mapping(path) == values
