"""The zoo: exported policies act bit for bit like the checkpoints that they come from, and are found by name."""

from __future__ import annotations

import functools
import json
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors import safe_open
from safetensors.torch import load as from_bytes
from safetensors.torch import load_file, save_file

from algorithms import PCN, zoo
from algorithms.actor_critic import ActorCritic
from algorithms.common.accrued_reward import AccruedReward
from algorithms.common.atomic_io import write_json
from algorithms.evaluation.evaluate import evaluate
from algorithms.evaluation.front import Front
from algorithms.experiments.build import build, make_environment
from algorithms.experiments.config import Experiment, load_experiment, make_experiment
from algorithms.experiments.policy_evaluation import evaluate_front
from algorithms.experiments.run_directory import Run, versions
from algorithms.zoo.exporting import FILES, export
from tests.helpers.agents import INTERSECTION, ONE_WAYPOINT, SEA, exaggerate, same, state
from tests.helpers.paths import REPOSITORY

SHIPPED = Path(zoo.__file__).resolve().parent
KILOBYTE = 1000
LINEAR = {ONE_WAYPOINT: "one_waypoint_linear", INTERSECTION: "intersection_linear"}
SMALL_PCN = {
    "learning_rate": 1e-2,
    "hidden": [32, 32],
    "persistence": 0.95,
    "horizon_reduction": 0,
    "horizon_scale": 20.0,
}


def experiment_of(name: str, env_id: str, arguments: dict[str, Any], **hyperparameters: Any) -> Experiment:
    """A small one with four worlds."""
    values: dict[str, Any] = {
        "environment": {"id": env_id, "arguments": arguments},
        "algorithm": {"name": name, **hyperparameters},
        "training": {"total_timesteps": 3000 if name == "pcn" else 256, "num_envs": 4, "seed": 3},
        "evaluation": {"episodes": 1, "final_episodes": 1},
    }
    if env_id == SEA:
        values["utility"] = {"name": "linear", "arguments": {"weights": [1.0, 0.1]}}
    elif name != "pcn":
        values["utility"] = {"name": LINEAR[env_id]}
    return make_experiment(values)


ONE = functools.partial(experiment_of, env_id=ONE_WAYPOINT, steps=8, hidden=[16])
TWO = functools.partial(experiment_of, env_id=INTERSECTION, steps=8, hidden=[16], arguments={"time_limit": 3})
FRONT = functools.partial(experiment_of, "pcn", ONE_WAYPOINT, **SMALL_PCN)
ACTOR_CRITICS: dict[str, Callable[[], Experiment]] = {
    "a2c": lambda: ONE("a2c", arguments={"time_limit": 3}),
    "mo_a2c": lambda: ONE("mo_a2c", arguments={"time_limit": 3}),
    "mo_a2c, continuous": lambda: ONE("mo_a2c", arguments={"time_limit": 3, "action_type": "continuous"}),
    "mo_a2c, another environment": lambda: experiment_of("mo_a2c", SEA, {}, steps=8, hidden=[16]),
    "mo_ppo": lambda: ONE("mo_ppo", arguments={"time_limit": 3}),
    "a2c, two vehicles": lambda: TWO("a2c"),
    "mo_ppo, two vehicles": lambda: TWO("mo_ppo"),
    "mo_ppo, centralised critic": lambda: TWO("mo_ppo", centralised_critic=True),
}
FRONTS: dict[str, Callable[[], Experiment]] = {
    "pcn": lambda: FRONT({"time_limit": 3, "fixed_destination": True}),
    "pcn, continuous": lambda: FRONT({"time_limit": 3, "fixed_destination": True, "action_type": "continuous"}),
}
EVERY_ACTOR_CRITIC = pytest.mark.parametrize("kind", ACTOR_CRITICS)
EVERY_FRONT = pytest.mark.parametrize("kind", FRONTS)
EVERY_KIND = pytest.mark.parametrize("kind", [*ACTOR_CRITICS, *FRONTS])

Trained = Callable[[str], Run]
Done = tuple[int, str, str]  # exit code, standard output, standard error
Call = Callable[..., Done]


def train(experiment: Experiment, path: Path) -> Run:
    """A run as far as exporting needs it; our actor-critics' policies are far from their nearly uniform first ones."""
    run = Run.create(experiment, path)
    run.unlock()
    agent = build(experiment)
    agent.train(experiment.training.total_timesteps)
    if isinstance(agent, ActorCritic) and agent.env.native:
        exaggerate(agent)
    agent.save(run.checkpoint)
    if isinstance(agent, PCN):
        evaluate_front(agent, experiment, episodes=1, seed=0).write(path, {"step": agent.step})
    return run


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """The run of a kind, trained once."""
    folder = tmp_path_factory.mktemp("runs")

    @functools.cache
    def get(kind: str) -> Run:
        return train({**ACTOR_CRITICS, **FRONTS}[kind](), folder / kind)

    return get


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty zoo in the place of the package's."""
    folder = tmp_path / "zoo"
    folder.mkdir()
    monkeypatch.setattr(zoo, "ZOO", folder)
    return folder


@pytest.fixture
def call(
    load_script: Callable[[str], ModuleType],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> Call:
    """Run a script in the test's folder, on lines long enough for its tables."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    def call(script: str, *arguments: Any) -> Done:
        module = load_script(script)
        monkeypatch.setattr(module, "make_console", lambda: Console(width=250))
        capfd.readouterr()
        try:
            code = module.main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code
        said = capfd.readouterr()
        return code, said.out, said.err

    return call


def refused(done: Done, *messages: str) -> None:
    """It ended with code 2 and one message on standard error."""
    code, out, error = done
    assert code == 2, out + error
    assert error.startswith("error: ")
    for part in messages:
        assert part in error


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def whole_agent(run: Run) -> Any:
    """The agent of a run's whole checkpoint."""
    agent = build(run.experiment)
    agent.load(run.checkpoint)
    return agent


def policy_of(path: Path) -> Any:
    """One world's agent with the policy of a folder."""
    run = Run.open(path)
    agent = build(run.experiment, num_envs=1)
    agent.load(run.checkpoint, policy_only=True)
    return agent


def actions_of(policy: Any, generator: torch.Generator | None) -> np.ndarray:
    """What a policy does in 40 states that it has never seen."""
    worlds, rng = policy.env, np.random.default_rng(1)
    n, d = 40, len(worlds.objectives)
    accrued_reward = AccruedReward.begin(n, worlds.vehicles, d)
    accrued_reward.value[:] = rng.normal(size=accrued_reward.value.shape) * worlds.objective_scales
    accrued_reward.discounts[:] = rng.uniform(0.5, 1.0, accrued_reward.discounts.shape)
    observations = rng.normal(size=(n, worlds.vehicles, worlds.observation_size)) * worlds.observation_scales
    return policy.act(observations.astype(np.float32), accrued_reward, generator)


def assert_same_drives(first: Any, second: Any, experiment: Experiment) -> None:
    """Two policies drive the same episodes, bit for bit, greedily and not."""
    for greedy in (True, False):
        found = [
            evaluate(policy, make_environment(experiment.environment, 3), episodes=4, seed=7, greedy=greedy, gamma=0.9)
            for policy in (first, second)
        ]
        for name in ("returns", "discounted", "lengths", "succeeded", "ends"):
            np.testing.assert_array_equal(getattr(found[0], name), getattr(found[1], name), err_msg=name)
        actions = [
            actions_of(policy, None if greedy else torch.Generator().manual_seed(2)) for policy in (first, second)
        ]
        assert actions[0].tobytes() == actions[1].tobytes()
        assert greedy or len(np.unique(actions[0])) > 1


# What an exported policy does and holds.


@EVERY_ACTOR_CRITIC
def test_an_exported_policy_acts_bit_for_bit_like_the_whole_checkpoint(
    trained: Trained, kind: str, tmp_path: Path
) -> None:
    run = trained(kind)
    path = export(run, "policy", tmp_path)
    assert_same_drives(whole_agent(run), policy_of(path), run.experiment)


@EVERY_FRONT
def test_an_exported_front_is_bit_for_bit_that_of_the_whole_checkpoint(
    trained: Trained, kind: str, tmp_path: Path
) -> None:
    run = trained(kind)
    path = export(run, "policy", tmp_path)
    whole, alone = whole_agent(run), policy_of(path)
    for first, second in zip(whole.commands(), alone.commands(), strict=True):
        assert first.dtype == second.dtype
        assert first.tobytes() == second.tobytes()
    settings: dict[str, Any] = {"episodes": 2, "seed": 4, "gamma": 0.99}
    fronts = [each.front(make_environment(run.experiment.environment, 5), **settings) for each in (whole, alone)]
    for name in ("returns", "discounted", "conditions", "length", "success"):
        np.testing.assert_array_equal(getattr(fronts[0], name), getattr(fronts[1], name), err_msg=name)
    assert len(fronts[0]) > 1
    for condition in fronts[0].conditions:
        assert_same_drives(*(each.policy(condition) for each in (whole, alone)), run.experiment)
    assert (path / "front.csv").read_bytes() == (run.path / "front.csv").read_bytes()


def test_a_front_that_shows_fewer_policies_shows_the_same_ones(trained: Trained, tmp_path: Path) -> None:
    run = trained("pcn")
    agents = whole_agent(run), policy_of(export(run, "policy", tmp_path))
    for agent in agents:
        agent.config = agent.config.model_copy(update={"max_policies": 3})
    (first, _), (second, _) = (agent.commands() for agent in agents)
    assert len(first) == 3
    assert first.tobytes() == second.tobytes()


def test_a_policy_that_learns_on_follows_its_own_episodes(trained: Trained, tmp_path: Path) -> None:
    agent = policy_of(export(trained("pcn"), "policy", tmp_path))
    agent.train(200)
    returns, lengths = agent.commands()
    best = agent.store.best()
    assert {*map(tuple, returns)} <= {*map(tuple, agent.store.returns[best].astype(np.float32))}
    assert {*lengths} <= {*agent.store.lengths[best]}


def test_a_policy_takes_the_place_of_another_one(trained: Trained, tmp_path: Path) -> None:
    """Nothing is left of what was loaded before, whichever kind of file comes first."""
    first, second = trained("pcn"), train(FRONT({"time_limit": 1, "fixed_destination": True}), tmp_path / "other")
    alone = export(second, "policy", tmp_path) / zoo.CHECKPOINT
    expected = [each.tobytes() for each in whole_agent(second).commands()]
    for before, after in ((first.checkpoint, alone), (alone, second.checkpoint), (alone, first.checkpoint)):
        agent = build(first.experiment, num_envs=1)
        agent.load(before, policy_only=True)
        agent.load(after, policy_only=True)
        found = [each.tobytes() for each in agent.commands()]
        assert (found == expected) == (after != first.checkpoint)


@EVERY_KIND
def test_what_driving_does_not_need_is_neither_written_nor_read(trained: Trained, kind: str, tmp_path: Path) -> None:
    run = trained(kind)
    policy = export(run, "policy", tmp_path) / zoo.CHECKPOINT
    allowed = ("bounds", "network.", "attained.") if kind in FRONTS else ("vehicle_0.actor.", "vehicle_1.actor.")
    tensors, whole = load_file(policy), load_file(run.checkpoint)
    assert all(name.startswith(allowed) for name in tensors)
    assert same(
        {name: tensor for name, tensor in tensors.items() if not name.startswith("attained.")},
        {name: tensor for name, tensor in whole.items() if name.startswith(allowed)},
    )
    if kind in ACTOR_CRITICS:
        agent = build(run.experiment, num_envs=1)
        before = state(agent)
        stripped = tmp_path / "stripped"
        with safe_open(run.checkpoint, framework="pt") as file:
            save_file({name: whole[name] for name in tensors}, stripped, file.metadata())
        for path in (policy, run.checkpoint, stripped):  # a whole checkpoint's actor is enough, too
            agent.load(path, policy_only=True)
            for name, tensor in state(agent).items():
                wanted = tensors[f"vehicle_{name}"] if ".actor." in name else before[name]
                assert torch.equal(tensor, wanted), name


@pytest.mark.parametrize(
    ("config", "overrides", "limit"),
    [
        ("one_waypoint/mo_a2c_nonlinear", (), 50),
        ("static_obstacle/a2c_linear", (), 100),
        ("intersection/mo_ppo_nonlinear", (), 120),
        ("one_waypoint/pcn", ("--algorithm.gradient_steps=1",), 50),
        ("static_obstacle/pcn", ("--algorithm.gradient_steps=1",), 50),
    ],
)
def test_policies_of_our_configs_are_small(config: str, overrides: tuple[str, ...], limit: int, tmp_path: Path) -> None:
    settings = ["--training.total_timesteps=1", *overrides]
    run = train(load_experiment(REPOSITORY / "configs" / f"{config}.yaml", settings), tmp_path / "run")
    path = export(run, "policy", tmp_path) / zoo.CHECKPOINT
    tensors = load_file(path)
    assert path.stat().st_size < limit * KILOBYTE
    assert path.stat().st_size < sum(tensor.nbytes for tensor in tensors.values()) + 3 * KILOBYTE
    assert path.stat().st_size < run.checkpoint.stat().st_size / 4


@pytest.mark.parametrize("kind", ["mo_ppo, centralised critic", "pcn"])
def test_a_folder_says_where_its_policy_comes_from(trained: Trained, kind: str, tmp_path: Path) -> None:
    run = trained(kind)
    path = export(run, "policy", tmp_path, {"chosen": "best of five seeds"})
    front = {"front.csv", "evaluation.json"} if kind == "pcn" else set()
    assert {file.name for file in path.iterdir()} == {"config.yaml", "checkpoint.safetensors", "about.json", *front}
    assert Run.open(path).experiment == run.experiment
    about = json.loads((path / "about.json").read_text())
    step = whole_agent(run).step
    assert step >= 256
    made_with = {name: versions()[name] for name in ("python", "packages")}
    assert about == {"seed": 3, "step": step, **made_with, "chosen": "best of five seeds"}
    with safe_open(path / zoo.CHECKPOINT, framework="pt") as file:
        stated = json.loads(file.metadata()["checkpoint"])
    assert (stated["policy_only"], stated["step"]) == (True, step)


def test_a_policy_trained_elsewhere_drives_on_a_cpu(trained: Trained, tmp_path: Path) -> None:
    run = trained("a2c")
    training = run.experiment.training.model_copy(update={"device": "cuda:99"})
    elsewhere = Run(run.path, run.experiment.model_copy(update={"training": training}))
    assert Run.open(export(elsewhere, "policy", tmp_path)).experiment.training.device == "cpu"


def test_a_policy_can_be_exported_from_a_policy(trained: Trained, tmp_path: Path) -> None:
    for kind in ("mo_ppo, two vehicles", "pcn"):
        first = export(trained(kind), "first", tmp_path)
        second = export(Run.open(first), "second", tmp_path)
        assert same(load_file(first / zoo.CHECKPOINT), load_file(second / zoo.CHECKPOINT))


# What is refused.


@EVERY_KIND
def test_training_cannot_be_resumed_from_a_policy_alone(trained: Trained, kind: str, tmp_path: Path) -> None:
    run = trained(kind)
    path = export(run, "policy", tmp_path) / zoo.CHECKPOINT
    for worlds in (1, 4):
        agent = build(run.experiment, num_envs=worlds)
        agent.save(tmp_path / "before")
        with pytest.raises(ValueError, match=r"checkpoint\.safetensors holds the policy alone.* cannot be resumed"):
            agent.load(path)
        agent.save(tmp_path / "after")
        assert (tmp_path / "before").read_bytes() == (tmp_path / "after").read_bytes()


def test_there_is_no_policy_of_a_front_before_training(tmp_path: Path) -> None:
    agent = build(FRONTS["pcn"]())
    with pytest.raises(ValueError, match="the store holds no episode yet"):
        agent.save_policy(tmp_path / "policy")
    assert not list(tmp_path.iterdir())


@EVERY_KIND
def test_a_broken_policy_is_refused_and_changes_nothing(trained: Trained, kind: str, tmp_path: Path) -> None:
    run = trained(kind)
    path = export(run, "policy", tmp_path) / zoo.CHECKPOINT
    content = path.read_bytes()
    tensors = from_bytes(content)  # load_file would map the file into memory, which is about to change
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    agent = build(run.experiment, num_envs=1)

    def check(message: str) -> None:
        agent.save(tmp_path / "before")
        with pytest.raises(ValueError, match=message):
            agent.load(path, policy_only=True)
        agent.save(tmp_path / "after")
        assert (tmp_path / "before").read_bytes() == (tmp_path / "after").read_bytes()

    for kept in (0, 8, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:kept])
        check("cannot be read")
    path.write_bytes(pickle.dumps({"weights": [1.0]}) * 100)
    check("cannot be read")
    own = "attained." if kind in FRONTS else "vehicle_0.actor."
    for name in [name for name in tensors if name.startswith(own)]:
        save_file({each: tensor for each, tensor in tensors.items() if each != name}, path, metadata)
        check("best episodes of the policy are broken" if kind in FRONTS else f"has '{name}' of shape None")
        save_file({**tensors, name: tensors[name][:0]}, path, metadata)
        check("best episodes of the policy are broken" if kind in FRONTS else f"has '{name}' of shape ")
    path.unlink()
    check("cannot be read")


def test_a_policy_of_another_agent_is_refused(trained: Trained, tmp_path: Path) -> None:
    path = export(trained("mo_a2c"), "policy", tmp_path) / zoo.CHECKPOINT
    for kind, message in (
        ("a2c", "algorithm = 'mo_a2c'; this agent has 'a2c'"),
        ("pcn", "algorithm = 'mo_a2c'; this agent has 'pcn'"),
        ("mo_a2c, continuous", r"actions = \[22, False\]"),
        ("mo_a2c, another environment", "environment = "),
    ):
        with pytest.raises(ValueError, match=message):
            build(trained(kind).experiment, num_envs=1).load(path, policy_only=True)


def test_a_policy_is_read_without_running_code_from_it(
    trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbidden(*_: Any, **__: Any) -> None:
        raise AssertionError("a pickle is being read")

    paths = {kind: export(trained(kind), kind, tmp_path) for kind in ("mo_ppo", "pcn")}
    agents = {kind: policy_of(path) for kind, path in paths.items()}  # compiled code comes out of a pickle
    for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load"), (np, "load")):
        monkeypatch.setattr(module, name, forbidden)
    for kind, path in paths.items():
        agents[kind].load(path / zoo.CHECKPOINT, policy_only=True)


# Exporting.


def test_an_export_takes_the_place_of_the_policy_that_was_there(trained: Trained, home: Path) -> None:
    assert export(trained("pcn"), "policy") == home / "policy"
    assert zoo.names() == ["policy"]
    export(trained("a2c"), "policy")
    assert Run.open("policy").experiment == trained("a2c").experiment
    assert {path.name for path in home.iterdir()} == {"policy"}
    assert {path.name for path in (home / "policy").iterdir()} == {
        "config.yaml",
        "checkpoint.safetensors",
        "about.json",
    }


@pytest.mark.parametrize("calls", [*range(12), None])
@pytest.mark.parametrize("function", ["fsync", "replace"])
def test_an_export_that_fails_leaves_what_was_there(
    trained: Trained, home: Path, monkeypatch: pytest.MonkeyPatch, function: str, calls: int | None
) -> None:
    """After so many calls that succeed; None for none that fails."""
    export(trained("a2c"), "policy")
    other = trained("pcn")  # now: training writes too
    before, real, made = contents(home), getattr(os, function), 0

    def full(*arguments: Any) -> None:
        nonlocal made
        made += 1
        if made - 1 == calls:
            raise OSError("No space left on device")
        real(*arguments)

    with monkeypatch.context() as context:
        context.setattr(os, function, full)
        try:
            export(other, "policy")
        except OSError:
            assert contents(home) == before
        else:
            assert calls is None or calls >= made
            assert Run.open("policy").experiment == trained("pcn").experiment
    assert [path.name for path in home.iterdir()] == ["policy"]


@pytest.mark.parametrize("name", ["", ".", "..", "../policy", "a/b", "Policy", ".policy", "-p", "a b", "__pycache__"])
def test_names_that_are_no_plain_names_are_refused(trained: Trained, home: Path, name: str) -> None:
    with pytest.raises(ValueError, match=f"name {name!r} must be lower-case letters"):
        export(trained("a2c"), name)
    assert not list(home.iterdir())


def test_an_export_never_takes_the_place_of_anything_else(trained: Trained, tmp_path: Path) -> None:
    run = trained("a2c")
    shutil.copytree(run.path, tmp_path / "run")
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder" / "deep").mkdir(parents=True)
    before = contents(tmp_path)
    for name in ("run", "file", "folder"):
        with pytest.raises(ValueError, match=f"{name}' holds something else than a policy"):
            export(run, name, tmp_path)
    assert contents(tmp_path) == before


def test_a_run_without_a_policy_or_a_front_is_not_exported(trained: Trained, tmp_path: Path, home: Path) -> None:
    run = Run.create(ACTOR_CRITICS["a2c"](), tmp_path / "untrained")
    run.unlock()
    with pytest.raises(ValueError, match=r"checkpoint\.safetensors cannot be read"):
        export(run, "policy")
    shutil.copytree(trained("pcn").path, tmp_path / "unfinished")
    (tmp_path / "unfinished" / "front.csv").unlink()
    with pytest.raises(ValueError, match="unfinished' holds no front"):
        export(Run.open(tmp_path / "unfinished"), "policy")
    assert not list(home.iterdir())


# By name.


def test_policies_are_found_by_name(trained: Trained, home: Path) -> None:
    assert zoo.names() == []
    for name in ("two-mo_ppo", "one-a2c"):
        export(trained("a2c"), name)
    for name in ("half", ".one-a2c.tmp", "__pycache__"):
        (home / name).mkdir()
        (home / name / "config.yaml").write_text("")
    (home / ".one-a2c.tmp" / "checkpoint.safetensors").write_text("")
    assert zoo.names() == ["one-a2c", "two-mo_ppo"]
    assert zoo.find("one-a2c") == home / "one-a2c"
    assert Run.open("one-a2c").path == home / "one-a2c"
    assert Run.open(Path("one-a2c"), device="cpu").experiment == trained("a2c").experiment


def test_a_directory_of_that_name_comes_first(
    trained: Trained, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export(trained("a2c"), "mine")
    shutil.copytree(trained("mo_ppo").path, tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    assert Run.open("mine").path == Path("mine")
    assert Run.open("mine").experiment.algorithm["name"] == "mo_ppo"
    shutil.rmtree(tmp_path / "mine")
    (tmp_path / "mine").write_text("a file is no run")
    assert Run.open("mine").path == home / "mine"


def test_an_unknown_name_is_refused_with_the_nearest_one(trained: Trained, home: Path, call: Call) -> None:
    with pytest.raises(ValueError, match=r"^the zoo is empty$"):
        zoo.find("one_waypoint-a2c")
    refused(call("evaluate", "one_waypoint-a2c"), "'one_waypoint-a2c' is not a run directory, and the zoo is empty")
    export(trained("a2c"), "one_waypoint-a2c")
    export(trained("mo_ppo, two vehicles"), "intersection-mo_ppo")
    near = "the zoo has no policy 'one_waypont-a2c'; did you mean 'one_waypoint-a2c'? known: intersection-mo_ppo, "
    with pytest.raises(ValueError, match=near.replace("?", r"\?")):
        zoo.find("one_waypont-a2c")
    message = f"'one_waypont-a2c' is not a run directory, and {near}"
    refused(call("evaluate", "one_waypont-a2c"), message)
    refused(call("choose", "one_waypont-a2c", "--weights", "jerk=1"), message)
    refused(call("play", "--env", INTERSECTION, "--against", "one_waypont-a2c"), message)
    refused(call("train", "--resume", "one_waypont-a2c"), message)
    for name in ("", ".", "..", "../zoo/one_waypoint-a2c", "/"):
        with pytest.raises(ValueError, match="the zoo has no policy"):
            zoo.find(name)


def test_a_policy_is_evaluated_by_name_as_its_run_is(trained: Trained, home: Path, tmp_path: Path, call: Call) -> None:
    for name, kind in (("intersection-mo_ppo", "mo_ppo, two vehicles"), ("one_waypoint-pcn", "pcn")):
        run = trained(kind)
        export(run, name)
        before = contents(home)
        options = ["--episodes", 2, "--seed", 9]
        code, out, error = call("evaluate", name, *options)
        assert code == 0, out + error
        numbers = [
            text[text.index("greedy" if kind in ACTOR_CRITICS else "policy") :]
            for text in (out, call("evaluate", run.path, *options)[1])
        ]
        assert numbers[0] == numbers[1]
        assert contents(home) == before
        for what, folder in ((name, "by_name"), (run.path, "by_path")):
            assert call("evaluate", what, *options, "--output", folder)[0] == 0
        written = [json.loads((tmp_path / each / "evaluation.json").read_text()) for each in ("by_name", "by_path")]
        assert written[0] == written[1]
        assert contents(home) == before
        shutil.rmtree(tmp_path / "by_name")
        shutil.rmtree(tmp_path / "by_path")


@pytest.mark.parametrize(
    "preference", [["--weights", "distance=1", "jerk=0.01"], ["--target", "distance=2"]], ids=["weights", "target"]
)
def test_a_policy_of_a_front_is_chosen_by_name_as_of_its_run(
    trained: Trained, home: Path, call: Call, preference: list[str]
) -> None:
    run = trained("pcn")
    export(run, "front")
    before = contents(home)
    code, out, error = call("choose", "front", "--episodes", 2, *preference)
    assert code == 0, out + error
    expected = call("choose", run.path, "--episodes", 2, *preference)[1]
    table, last = (text.rsplit("policy ", 1) for text in (out, expected))
    assert table[0] == last[0]
    assert table[1].split()[0] == last[1].split()[0]
    assert contents(home) == before
    export(trained("a2c"), "single")
    refused(call("choose", "single", *preference), "'single' learnt one policy, not a front")


def test_one_drives_against_a_policy_by_name(
    trained: Trained, home: Path, load_script: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = trained("mo_ppo, two vehicles")
    export(run, "intersection-mo_ppo")
    before = contents(home)
    play = load_script("play")
    options = play.parse_arguments(["--env", INTERSECTION, "--against", "intersection-mo_ppo", "--vehicle", "1"])
    env, agent = play.open_environment(options)
    assert env.config.time_limit == 3
    assert_same_drives(whole_agent(run), agent, run.experiment)
    assert contents(home) == before


@EVERY_KIND
def test_a_policy_of_the_zoo_is_not_trained_on_and_stays_as_it_is(
    trained: Trained, home: Path, call: Call, kind: str
) -> None:
    path = export(trained(kind), "policy")
    before = contents(home)
    for what in ("policy", path):
        refused(call("train", "--resume", what), "holds the policy alone", "cannot be resumed")
    assert contents(home) == before


def test_the_zoo_is_listed(trained: Trained, home: Path, call: Call) -> None:
    assert call("evaluate", "--zoo") == (0, "the zoo is empty\n", "")
    kinds = {"first": "mo_ppo, two vehicles", "second": "pcn", "third": "mo_a2c, another environment"}
    for name, kind in kinds.items():
        export(trained(kind), name)
    code, out, error = call("evaluate", "--zoo")
    assert (code, error) == (0, "")
    rows = [line.split(maxsplit=1) for line in out.splitlines() if line.strip().startswith(tuple(kinds))]
    assert [(name, " ".join(rest.split())) for name, rest in rows] == [
        ("first", "intersection intersection_linear mo_ppo"),
        ("second", "one_waypoint all: a front pcn"),
        ("third", f"{SEA} linear mo_a2c"),
    ]
    (home / "first" / "config.yaml").write_text("algorithm: 3\n")
    refused(call("evaluate", "--zoo"), str(home / "first" / "config.yaml"))
    for arguments in ([], ["first", "--zoo"]):
        assert call("evaluate", *arguments)[0] == 2


def test_a_listing_names_the_utility_of_every_vehicle(trained: Trained, home: Path, call: Call) -> None:
    path = export(trained("a2c, two vehicles"), "policy")
    values = trained("a2c, two vehicles").experiment.to_dict()
    values["utility"]["vehicles"] = {"vehicle_1": {"name": "intersection_nonlinear"}}
    write_json(path / "config.yaml", values)  # JSON is YAML
    assert "intersection_linear, intersection_nonlinear" in call("evaluate", "--zoo")[1]


# What is shipped.


def test_the_policies_of_an_installed_package_are_found(trained: Trained, tmp_path: Path) -> None:
    pytest.importorskip("setuptools", minversion="77")
    source = tmp_path / "source"
    for name in ("algorithms", "mo_deepdrive"):
        shutil.copytree(REPOSITORY / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, source / name)
    for name, kind in (("one_waypoint-linear-a2c", "a2c"), ("one_waypoint-pcn", "pcn")):
        export(trained(kind), name, source / "algorithms" / "zoo")
    build_wheel = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build_wheel, str(tmp_path)], cwd=source, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    shutil.rmtree(source)
    expected = sorted({*zoo.names(), "one_waypoint-linear-a2c", "one_waypoint-pcn"})
    show = (
        "from algorithms import zoo; from algorithms.evaluation.front import Front; print(zoo.names());"
        "print(len(Front.read(zoo.find('one_waypoint-pcn'))), zoo.ZOO)"
    )
    done = subprocess.run(
        [sys.executable, "-c", show],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "installed")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    policies = len(Front.read(trained("pcn").path))
    assert done.stdout.splitlines() == [str(expected), f"{policies} {tmp_path / 'installed' / 'algorithms' / 'zoo'}"]


def test_the_zoo_holds_nothing_but_policies() -> None:
    folders = {path.name for path in SHIPPED.iterdir() if path.is_dir()} - {"__pycache__"}
    assert folders == {*zoo.names()}


@pytest.mark.parametrize("name", zoo.names())
def test_a_shipped_policy_loads_and_drives(name: str) -> None:
    path = zoo.find(name)
    assert {file.name for file in path.iterdir()} <= FILES
    assert sum(file.stat().st_size for file in path.iterdir()) < 200 * KILOBYTE
    about = json.loads((path / "about.json").read_text())
    run = Run.open(name)
    assert about["seed"] == run.experiment.training.seed
    assert about["step"] > 0
    assert run.experiment.training.device == "cpu"
    agent = policy_of(path)
    policy = agent
    if not run.experiment.known_utility:
        front = Front.read(path)
        assert front.objectives == agent.env.objectives
        desired, horizon = agent.commands()
        known = {tuple(row) for row in np.column_stack([desired, horizon])}
        assert {tuple(row) for row in front.conditions.astype(np.float32)} <= known
        policy = agent.policy(front.conditions[-1])
    for greedy in (True, False):
        found = evaluate(policy, make_environment(run.experiment.environment, 1), episodes=1, seed=5, greedy=greedy)
        assert np.isfinite(found.returns).all()
        assert (found.lengths > 1).any()
    with pytest.raises(ValueError, match="holds the policy alone"):
        agent.load(run.checkpoint)
