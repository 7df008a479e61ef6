"""Experiments: typed YAML, overrides, and errors that name the key, the value and what is allowed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import gymnasium
import pytest

import mo_deepdrive
from algorithms.runs.build import build
from algorithms.runs.config import load_experiment, make_experiment
from mo_deepdrive.support.yaml import dump

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

FRONT = """
environment:
  id: mo-deepdrive-one-waypoint-v0
algorithm:
  name: pcn
training:
  total_timesteps: 1e5
  num_envs: 2
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
    assert experiment.algorithm.config.learning_rate == 3e-4
    assert experiment.algorithm.config.gamma == 0.99


def test_the_resolved_experiment_reloads_equal(write: Write, tmp_path: Path) -> None:
    overrides = ["--logging.wandb={project: p, tags: [a, '1e3']}", "--environment.arguments.objectives=[distance]"]
    experiment = load_experiment(write(TEXT), overrides)
    path = tmp_path / "resolved.yaml"
    path.write_text(dump(experiment.to_dict()))
    assert load_experiment(path) == experiment
    assert make_experiment(experiment.to_dict()) == experiment


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "--training.total_timesteps=3_000_001",
            "training.total_timesteps = 3,000,001: task K1 allows 3,000,000 environment steps",
        ),
        (
            "--environment.id=mo-deepdrive-static-obstacle-v0",
            "task K1 needs another environment: environment.id = 'mo-deepdrive-static-obstacle-v0'",
        ),
        ("--environment.arguments.action_delay=1", r"environment.arguments.action_delay = 1 \(not 0\)"),
        ("--evaluation.task=K9", "task 'K9' is unknown"),
        ("--evaluation.follow_changes=false", "follow_changes = False has no effect: no preference of task K1 changes"),
    ],
)
def test_a_task_of_the_suite_is_trained_in_its_environment_and_within_its_budget(
    write: Write, override: str, message: str
) -> None:
    task = [
        "--environment={id: mo-deepdrive-static-obstacle-v1, arguments: {}}",
        "--utility.name=static_obstacle_linear",
        "--evaluation.task=K1",
    ]
    assert load_experiment(write(TEXT), task).evaluation.task == "K1"
    with pytest.raises(ValueError, match=message):
        load_experiment(write(TEXT), [*task, override])


def test_overrides_change_the_experiment_and_the_last_one_counts(write: Write) -> None:
    overrides = ["--algorithm.gamma=1", "--seed", "3", "--algorithm={'steps': 4, 'hidden': [8]}", "--training.seed=4"]
    experiment = load_experiment(write(TEXT), overrides)
    assert experiment.training.seed == 4
    assert experiment.algorithm.config.gamma == 1.0
    assert experiment.algorithm.config.steps == 4
    assert experiment.algorithm.config.hidden == [8]
    assert experiment.algorithm.config.learning_rate == 3e-4


def test_an_empty_mapping_clears_what_the_file_has() -> None:
    config = "intersection/mo_ppo_nonlinear_tuned"
    assert list(load_experiment(config, []).training.guides) == ["vehicle_0"]
    assert load_experiment(config, ["--training.guides={}"]).training.guides == {}
    merged = load_experiment(config, ["--training.guides={'vehicle_0': {'share': 0.25}}"]).training.guides["vehicle_0"]
    assert (merged.driver, merged.share) == ("rule:gap_6", 0.25)


def test_the_file_of_a_sweep_is_refused_with_the_command_for_it() -> None:
    message = "'sweeps/search' is the file of a sweep; mo-deepdrive sweep --config sweeps/search trains its runs"
    with pytest.raises(ValueError, match=message):
        load_experiment("sweeps/search")


@pytest.mark.parametrize(
    ("override", "messages"),
    [
        ("--algorithm.learning_rat=1", ["learning_rat", "did you mean 'learning_rate'"]),
        ("--algoritm.gamma=1", ["algoritm", "did you mean 'algorithm'"]),
        ("--training.sed=1", ["training.sed", "did you mean 'seed'"]),
        ("--environment.arguments.time_limi=1", ["time_limi", "did you mean 'time_limit'"]),
        ("--environment.arguments.scenario=intersection", ["scenario", "set by the id"]),
        (
            "--environment.id=no_such_module:x-v0",
            ["'no_such_module' cannot be imported: ModuleNotFoundError", "looked for in '"],
        ),
        ("--environment.id=commute-v0", ["is not registered; for one of your own write 'module:commute-v0'"]),
        ("--environment.arguments.objectives=[effort]", ["objectives has 'effort'", "an id of the form 'module:ID'"]),
        ("--algorithm.name=mo_a2d", ["mo_a2d", "did you mean 'mo_a2c'"]),
        ("--algorithm.name=[1]", ["algorithm.name", "known: a2c, conditioned_mo_ppo, mappo, mo_a2c"]),
        ("--algorithm.learning_rate=fast", ["'learning_rate' = 'fast'", "number"]),
        ("--training.total_timesteps=0", ["training.total_timesteps", "greater than or equal to 1"]),
        ("--training.device=abacus", ["training.device", "abacus", "cpu, cuda"]),
        ("--training.device=cuda:99", ["training.device", "cuda:99", "does not exist"]),
        (
            "--evaluation.reference_point=[0, 0, 0, 0]",
            ["evaluation.reference_point = [0.0, 0.0, 0.0, 0.0] has no effect"],
        ),
        ("--evaluation.follow_changes=false", ["follow_changes = False has no effect: no task of the suite is scored"]),
        ("--utility.vehicles.vehicle_1.nam=x", ["utility.vehicles.vehicle_1.nam", "did you mean 'name'"]),
        ("--training.seed.x.y=1", ["training.seed"]),
        ("--training.total_timesteps=1e300", ["training.total_timesteps", "less than or equal to 1000000000000000"]),
        ("--utility.arguments={objectives: [a]}", ["utility.arguments", "'objectives' is set by the environment"]),
        ('--environment.id="a\\nb"', ["environment.id = 'a\\nb'", "write 'module:a\\nb', which"]),
        ("seed=3", ["'seed=3' is not of the form"]),
        ("--a..b=1", ["is not of the form"]),
        ("--seed", ["has no value"]),
        ("--algorithm=[1,", ["--algorithm: '[1,' is not a valid value"]),
        (f"--algorithm.gamma={'x' * 9999}", [f"= '{'x' * 299}...: Input should be a valid number"]),
    ],
)
def test_invalid_values_are_named_with_what_is_allowed(write: Write, override: str, messages: list[str]) -> None:
    path = write(TEXT + "  seed: 1\n")
    with pytest.raises(ValueError) as caught:  # noqa: PT011  (the message is looked at below)
        load_experiment(path, [override])
    for message in messages:
        assert message in str(caught.value)


def test_several_problems_are_named_at_once(write: Write) -> None:
    with pytest.raises(ValueError, match=r"learning_rat.*time_limi.*abacus"):
        load_experiment(
            write(TEXT), ["--environment.arguments.time_limi=1", "--algorithm.learning_rat=1", "--device=abacus"]
        )


# Algorithms that learn a front.


def test_a_utility_is_required_or_refused_depending_on_the_algorithm(write: Write) -> None:
    assert load_experiment(write(TEXT)).known_utility is True
    found = load_experiment(write(FRONT))
    assert found.known_utility is False
    assert found.utility is None
    for name in ("a2c", "mo_a2c", "mo_ppo"):
        with pytest.raises(ValueError, match=f"'utility' is missing: algorithm '{name}' learns for a known utility"):
            load_experiment(write(FRONT), [f"--algorithm.name={name}"])
    with pytest.raises(ValueError, match=r"utility = 'one_waypoint_linear': algorithm 'pcn' learns a front"):
        load_experiment(write(FRONT), ["--utility.name=one_waypoint_linear"])


def test_our_environments_have_a_default_reference_point(write: Write) -> None:
    overrides = ["--environment.arguments.action_type=continuous", "--evaluation.gamma=1.0"]
    found = load_experiment(write(FRONT), overrides).evaluation.reference_point
    assert found == mo_deepdrive.reference_point("one_waypoint", "continuous", 1.0).values.tolist()


def test_a_front_with_time_is_undiscounted_unless_its_discount_is_given(write: Write) -> None:
    v1 = "--environment.id=mo-deepdrive-static-obstacle-v1"
    evaluation = load_experiment(write(FRONT), [v1]).evaluation
    names = gymnasium.spec("mo-deepdrive-static-obstacle-v1").kwargs["objectives"]
    expected = mo_deepdrive.reference_point("static_obstacle", objectives=names)
    assert (evaluation.gamma, evaluation.reference_point) == (1.0, expected.values.tolist())
    given = load_experiment(write(FRONT), [v1, "--evaluation.gamma=0.99"])
    assert given.evaluation.gamma == 0.99
    assert make_experiment(given.to_dict()) == given
    assert load_experiment(write(FRONT)).evaluation.gamma == 0.99


def test_only_fronts_of_our_environments_get_a_reference_point(write: Write) -> None:
    assert load_experiment(write(TEXT)).evaluation.reference_point is None
    sea = "--environment={id: deep-sea-treasure-v0, arguments: {}}"
    assert load_experiment(write(FRONT), [sea]).evaluation.reference_point is None
    given = load_experiment(write(FRONT), [sea, "--evaluation.reference_point=[0.0, -25.0]"])
    assert given.evaluation.reference_point == [0.0, -25.0]
    assert build(given).env.objectives == ("objective_0", "objective_1")


@pytest.mark.parametrize(
    ("override", "messages"),
    [
        ("--evaluation.gamma=0.5", ["evaluation.reference_point must be given", "gamma = 0.5", "known: 0.99, 1.0"]),
        ("--environment.arguments.cost_sign=paper", ["environment.arguments.cost_sign = 'paper'", "'maximise'"]),
    ],
)
def test_invalid_settings_of_a_front_are_named(write: Write, override: str, messages: list[str]) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011  (the message is looked at below)
        load_experiment(write(FRONT), [override])
    for message in messages:
        assert message in str(caught.value)
