"""Every actor-critic runs, repeats with its seed, resumes bit for bit, refuses other agents' checkpoints and learns."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from algorithms import A2C, MAPPO, MOA2C, MOCAC, MOPPO, PPO, ConditionedMOPPO, RulebookPPO
from algorithms.actor_critic import ActorCritic
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.utilities import make_utility
from tests.helpers.agents import (
    CLASSES,
    CONTINUOUS,
    FORMS,
    INTERSECTION,
    LEFT_TURN,
    MINECART,
    ONE_WAYPOINT,
    ROUNDABOUT,
    SEA,
    STATIC_OBSTACLE,
    exaggerate,
    make_agent,
    recorded,
    same,
    state,
)

PLACES: dict[str, tuple[str, dict[str, Any]]] = {
    "one_waypoint": (ONE_WAYPOINT, {}),
    "one_waypoint, 16 actions": (ONE_WAYPOINT, {"action_type": "discrete-16"}),
    "one_waypoint, continuous": (ONE_WAYPOINT, CONTINUOUS),
    "static_obstacle": (STATIC_OBSTACLE, {}),
    "static_obstacle, continuous": (STATIC_OBSTACLE, CONTINUOUS),
    "left_turn": (LEFT_TURN, {}),
    "intersection": (INTERSECTION, {}),
    "intersection, continuous": (INTERSECTION, CONTINUOUS),
    "deep-sea-treasure": (SEA, {}),
    "minecart": (MINECART, {}),
    "mountaincar, continuous": ("mo-mountaincarcontinuous-v0", {}),
}


EVERYWHERE = pytest.mark.parametrize("place", PLACES)


UPDATES = 3


def small_run(cls: type[ActorCritic], place: str, seed: int = 0, **hyperparameters: Any) -> ActorCritic:
    env_id, arguments = PLACES[place]
    agent = make_agent(cls, env_id, num_envs=2, env=arguments, seed=seed, steps=8, **hyperparameters)
    agent.train(UPDATES * 16)
    return agent


@pytest.mark.slow
@CLASSES
@EVERYWHERE
def test_training_runs_and_the_policy_gives_valid_actions(cls: type[ActorCritic], place: str) -> None:
    agent = small_run(cls, place)
    assert agent.step == UPDATES * 16
    fresh = state(make_agent(cls, PLACES[place][0], num_envs=2, env=PLACES[place][1], steps=8))
    trained = state(agent)
    for v in range(agent.env.vehicles):
        for name in (f"{v}.actor.body.0.weight", f"{v}.critic.0.weight"):
            assert not torch.equal(trained[name], fresh[name])
    assert all(tensor.isfinite().all() for tensor in trained.values())
    env = make_env(PLACES[place][0], 1, PLACES[place][1])
    observation = env.reset(seed=0)[0][0]
    accrued = np.zeros((agent.env.vehicles, len(agent.env.objectives))).squeeze()
    action = agent.eval(observation, accrued)
    assert env.single_action_space.contains(action)
    np.testing.assert_array_equal(action, agent.eval(observation, accrued_reward=None, discount=1.0))


@CLASSES
def test_training_stops_at_the_first_update_that_reaches_the_total(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, num_envs=4, steps=5)
    agent.train(41)
    assert agent.step == 60
    agent.train(60)
    assert agent.step == 60


@CLASSES
def test_training_stops_when_after_update_returns_true(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, num_envs=4, steps=5)
    seen = []

    def after_update(trained: ActorCritic) -> bool:
        assert trained is agent
        seen.append(trained.step)
        return len(seen) == 2

    agent.train(1000, after_update=after_update)
    assert seen == [20, 40]


def test_metrics_are_logged_at_the_log_interval_and_at_the_end() -> None:
    lines = recorded(make_agent(MOA2C, num_envs=4, steps=5, env={"time_limit": 0.3}), 140, log_interval=3)
    assert [step for step, _ in lines] == [60, 120, 140]
    metrics = lines[0][1]
    assert metrics["train/length"] == 3.0
    names = {"train/utility", "train/success", "train/return/jerk", "loss/policy", "loss/value", "policy/entropy"}
    assert names < metrics.keys()
    assert all(math.isfinite(value) for value in metrics.values())


@pytest.mark.parametrize(
    ("options", "least"), [({"log_interval": 0}, 1), ({"eval_interval": 0}, 1), ({"total_timesteps": -1}, 0)]
)
def test_intervals_and_steps_that_are_too_small_are_refused(options: dict[str, int], least: int) -> None:
    agent = make_agent(MOA2C)
    [(name, value)] = options.items()
    with pytest.raises(ValueError, match=f"{name} = {value} must be at least {least}"):
        agent.train(**{"total_timesteps": 64, **options})
    assert agent.step == 0


def test_an_update_that_takes_no_steps_does_not_go_on_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make_agent(MOA2C)
    monkeypatch.setattr(agent, "update", lambda _progress: {})
    with pytest.raises(RuntimeError, match="must add the environment steps that it takes to step"):
        agent.train(64)


def test_evaluations_happen_before_during_and_after_training() -> None:
    agent = make_agent(A2C, num_envs=4, steps=5, env={"time_limit": 0.5})
    eval_env = make_env(ONE_WAYPOINT, 2, {"time_limit": 0.5})
    lines = recorded(agent, 200, eval_env=eval_env, eval_interval=60, eval_episodes=3, log_interval=1000)
    evaluated = [step for step, metrics in lines if "eval/greedy/utility_esr" in metrics]
    assert evaluated == [0, 60, 120, 180, 200]
    assert all(
        f"eval/{policy}/{name}" in lines[0][1]
        for policy in ("greedy", "stochastic")
        for name in ("utility_esr", "utility_ser", "success", "length", "return/jerk", "discounted_return/jerk")
    )


SHORT = {"time_limit": 0.8}


SCHEDULES = {"learning_rate_end": 1e-4, "entropy_start": 0.1, "entropy_end": 0.01}


RESUMED: dict[str, tuple[str, str, dict[str, Any]]] = {
    "a2c, one world, one step": ("a2c", ONE_WAYPOINT, {"num_envs": 1, "steps": 1}),
    "a2c": ("a2c", STATIC_OBSTACLE, {"num_envs": 3, "steps": 5}),
    "a2c, continuous": ("a2c", ONE_WAYPOINT, {"num_envs": 8, "steps": 4, "env": CONTINUOUS}),
    "a2c, two vehicles": ("a2c", INTERSECTION, {"num_envs": 3, "steps": 7}),
    "mo_a2c": ("utility_difference", ONE_WAYPOINT, {"num_envs": 8, "steps": 16}),
    "mo_a2c, small": ("utility_difference", ONE_WAYPOINT, {"num_envs": 1, "steps": 3, "hidden": [8]}),
    "mo_a2c, large": ("utility_difference", STATIC_OBSTACLE, {"num_envs": 33, "steps": 2, "hidden": [128, 64, 32]}),
    "mo_a2c, as printed": ("as_printed", STATIC_OBSTACLE, {"num_envs": 4, "steps": 6}),
    "mo_a2c, gradient": ("utility_gradient", ONE_WAYPOINT, {"num_envs": 4, "steps": 6}),
    "mo_a2c, gradient, two vehicles": ("utility_gradient", INTERSECTION, {"num_envs": 4, "steps": 6}),
    "mo_a2c, continuous, two vehicles": ("utility_difference", INTERSECTION, {"num_envs": 2, "env": CONTINUOUS}),
    "mo_a2c, expected utility": ("expected_utility", STATIC_OBSTACLE, {"num_envs": 4, "steps": 6}),
    "mo_a2c, expected utility, two vehicles": ("expected_utility", INTERSECTION, {"centralised_critic": True}),
    "mo_a2c, without discount": ("without discount", ONE_WAYPOINT, {"num_envs": 4, "steps": 6}),
    "mo_ppo": ("clipped", STATIC_OBSTACLE, {"num_envs": 4, "steps": 6}),
    "mo_ppo, two vehicles, central": ("clipped", INTERSECTION, {"num_envs": 3, "centralised_critic": True}),
    "mo_a2c, two vehicles, central": ("utility_difference", INTERSECTION, {"centralised_critic": True}),
    "ppo, one policy for all": ("ppo", ROUNDABOUT, {"share_policy": True}),
    "rulebook_ppo": ("rulebook", STATIC_OBSTACLE, {"num_envs": 4, "steps": 6}),
    "rulebook_ppo, two vehicles": ("rulebook", INTERSECTION, {"num_envs": 3}),
    "mocac, particles": ("particles", ONE_WAYPOINT, {"steps": 6}),
    "mocac, particles, two vehicles, central": ("particles", INTERSECTION, {"centralised_critic": True}),
    "mocac, grid": ("grid", ONE_WAYPOINT, {"steps": 6}),
    "mappo": ("mappo", INTERSECTION, {"joint": "gini"}),
    "mappo, one policy for both": ("mappo", INTERSECTION, {"share_policy": True}),
    "conditioned": ("conditioned", ONE_WAYPOINT, {"switching": 0.2, "env": CONTINUOUS}),
    "conditioned, families": ("families", ONE_WAYPOINT, {"steps": 6}),
    "conditioned, two vehicles": ("conditioned", INTERSECTION, {"steps": 6}),
}
MORE_FORMS: dict[str, tuple[type[Any], dict[str, Any]]] = {
    **FORMS,
    "clipped": (MOPPO, {}),
    "ppo": (PPO, {}),
    "rulebook": (RulebookPPO, {"multiplier_start": 0.1}),
    "particles": (MOCAC, {"particles": 5}),
    "grid": (MOCAC, {"critic": "categorical", "atoms": 3}),
    "mappo": (MAPPO, {}),
    "conditioned": (ConditionedMOPPO, {"cost_growth": 0.5}),
    "families": (
        ConditionedMOPPO,
        {"families": {"linear": 1, "chebyshev": 1, "comfort_budget": 1}, "budgets": {"jerk": 50}},
    ),
}


def resumable(name: str, seed: int) -> Any:
    form, env_id, arguments = RESUMED[name]
    cls, settings = MORE_FORMS[form]
    env = {**SHORT, **arguments.get("env", {})}
    return make_agent(cls, env_id, seed=seed, **{**settings, **SCHEDULES, **arguments, "env": env})


@pytest.mark.slow
@pytest.mark.parametrize("name", RESUMED)
def test_a_seed_determines_everything_and_another_seed_gives_others(name: str) -> None:
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    runs = []
    for seed in (5, 5, 6):
        agent = resumable(name, seed)
        agent.train(3 * agent.config.steps * agent.env.num_envs)
        runs.append({name: tensor.clone() for name, tensor in agent.get_state().items()})
    assert same(runs[0], runs[1])
    learnt = [name for name in runs[0] if name.endswith((".weight", ".exp_avg"))]
    assert not any(torch.equal(runs[0][name], runs[2][name]) for name in learnt)
    assert torch.equal(torch.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002


@pytest.mark.slow
@pytest.mark.parametrize("name", RESUMED)
@pytest.mark.parametrize("updates", [1, 4])
def test_a_resumed_run_is_the_uninterrupted_run_bit_for_bit(name: str, updates: int, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    whole = resumable(name, seed=3)
    per_update = whole.config.steps * whole.env.num_envs
    total = 7 * per_update
    lines = recorded(whole, total, log_interval=3)

    first = resumable(name, seed=3)
    start = recorded(first, total, log_interval=3, after_update=lambda agent: agent.step == updates * per_update)
    first.save(path)
    second = resumable(name, seed=99)  # nothing of its own is left after loading
    second.load(path)
    assert second.step == updates * per_update
    assert same(state(second), state(first))
    rest = recorded(second, total, log_interval=3)

    assert second.step == whole.step
    assert same(state(second), state(whole))
    assert same(whole.get_state(), second.get_state())
    assert start + rest == lines


@CLASSES
def test_a_checkpoint_of_an_untrained_agent_starts_the_same_run(cls: type[ActorCritic], tmp_path: Path) -> None:
    fresh = make_agent(cls, seed=1)
    fresh.save(tmp_path / "fresh")
    other = make_agent(cls, seed=1)
    other.load(tmp_path / "fresh")
    for agent in (fresh, other):
        agent.train(64)
    assert same(state(fresh), state(other))


@CLASSES
def test_saving_changes_nothing(cls: type[ActorCritic], tmp_path: Path) -> None:
    plain, saved = make_agent(cls), make_agent(cls)
    plain.train(256)

    def save(agent: ActorCritic) -> bool:
        agent.save(tmp_path / "checkpoint")
        return False

    saved.train(256, after_update=save)
    assert same(state(plain), state(saved))


@CLASSES
def test_training_resumes_where_the_environment_cannot_be_saved(cls: type[ActorCritic], tmp_path: Path) -> None:
    first = make_agent(cls, SEA, steps=8)
    first.train(64)
    first.save(tmp_path / "checkpoint")
    second = make_agent(cls, SEA, steps=8)
    second.load(tmp_path / "checkpoint")
    second.train(128)
    assert second.step == 128


@CLASSES
def test_the_policy_alone_can_be_loaded_for_any_number_of_environments(cls: type[ActorCritic], tmp_path: Path) -> None:
    trained = make_agent(cls, num_envs=4, seed=3)
    trained.train(64)
    exaggerate(trained)
    trained.save(tmp_path / "checkpoint")
    other = make_agent(cls, num_envs=1, seed=8)
    other.load(tmp_path / "checkpoint", policy_only=True)
    assert other.step == 0
    observations = np.random.default_rng(0).normal(0.0, 10.0, (50, 15)).astype(np.float32)
    actions = [int(trained.eval(x)) for x in observations]
    assert len(set(actions)) > 1
    assert [int(other.eval(x)) for x in observations] == actions
    with pytest.raises(ValueError, match="num_envs = 4; this agent has 1"):
        other.load(tmp_path / "checkpoint")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of MO-A2C on OneWaypoint with four environments, after two updates."""
    path = tmp_path_factory.mktemp("checkpoint") / "mo_a2c.safetensors"
    agent = make_agent(MOA2C, steps=8)
    agent.train(64)
    agent.save(path)
    return path


def refused(agent: ActorCritic, path: Path, message: str) -> None:
    """Loading raises ValueError with ``message``, and leaves the agent as it was."""
    before = state(agent)
    for policy_only in (False, True):
        with pytest.raises(ValueError, match=message):
            agent.load(path, policy_only=policy_only)
    assert same(state(agent), before)
    assert agent.step == 0


def test_a_missing_checkpoint_is_refused(tmp_path: Path) -> None:
    refused(make_agent(MOA2C), tmp_path / "absent.safetensors", "absent.safetensors cannot be read")
    refused(make_agent(MOA2C), tmp_path, "cannot be read")


@pytest.mark.parametrize("kept", [0, 4, 8, 100, 0.3, 0.99, -1])
def test_a_truncated_checkpoint_is_refused(checkpoint: Path, tmp_path: Path, kept: float) -> None:
    data = checkpoint.read_bytes()
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(data[: int(kept * len(data)) if isinstance(kept, float) else kept])
    refused(make_agent(MOA2C), broken, "broken.safetensors cannot be read")


def test_any_other_file_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_bytes(pickle.dumps({"weights": [1.0]}) * 100)
    refused(make_agent(MOA2C), other, "other")
    save_file({"weights": torch.zeros(3)}, other)
    refused(make_agent(MOA2C), other, "has .* = None; this agent has")
    save_file({"weights": torch.zeros(3)}, other, metadata={"checkpoint": "{"})
    refused(make_agent(MOA2C), other, "cannot be read")


def test_a_checkpoint_that_lacks_tensors_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    with safe_open(checkpoint, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(checkpoint)
    del tensors["vehicle_0.actor.body.0.weight"]
    save_file(tensors, tmp_path / "partial", metadata=metadata)
    refused(make_agent(MOA2C), tmp_path / "partial", "partial")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_agent(A2C), "algorithm = 'mo_a2c'; this agent has 'a2c'"),
        (lambda: make_agent(MOA2C, STATIC_OBSTACLE), "has (environment|observation_size|objectives) = "),
        (lambda: make_agent(MOA2C, SEA), "has (environment|observation_size|objectives|actions) = "),
        (
            lambda: make_agent(MOA2C, env={"objectives": ["distance", "jerk"]}),
            r"objectives = \['distance', 'destination', 'g_force', 'jerk'\]; this agent has \['distance', 'jerk'\]",
        ),
        (
            lambda: make_agent(MOA2C, env={"objectives": ["jerk", "distance", "destination", "g_force"]}),
            "objectives = ",
        ),
        (lambda: make_agent(MOA2C, env=CONTINUOUS), r"actions = \[22, False\]; this agent has \[3, True\]"),
        (lambda: make_agent(MOA2C, env={"action_type": "discrete-16"}), r"actions = \[22, False\]"),
        (lambda: make_agent(MOA2C, hidden=[64, 16]), r"hidden = \[64, 32\]; this agent has \[64, 16\]"),
        (lambda: make_agent(MOA2C, hidden=[64]), r"hidden = \[64, 32\]; this agent has \[64\]"),
        (lambda: make_agent(MOA2C, observe_discount=False), "checkpoint"),
    ],
    ids=[
        "algorithm",
        "scenario",
        "foreign environment",
        "fewer objectives",
        "order of objectives",
        "continuous",
        "action set",
        "hidden sizes",
        "hidden layers",
        "inputs",
    ],
)
def test_a_checkpoint_of_another_agent_is_refused(
    checkpoint: Path, make: Callable[[], ActorCritic], message: str
) -> None:
    refused(make(), checkpoint, message)


def test_a_checkpoint_is_read_without_running_code_from_it(checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: Any, **__: Any) -> None:
        raise AssertionError("a pickle is being read")

    make_agent(MOA2C, steps=8).load(checkpoint)  # Numba loads compiled code from its cache, which is a pickle
    for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load"), (np, "load")):
        monkeypatch.setattr(module, name, forbidden)
    agent = make_agent(MOA2C, steps=8)
    agent.load(checkpoint)
    assert agent.step == 64


def test_a_failed_save_keeps_the_previous_checkpoint(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "checkpoint"
    path.write_bytes(checkpoint.read_bytes())

    def fail(*_: Any, **__: Any) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="no space left"):
        make_agent(A2C).save(path)
    assert path.read_bytes() == checkpoint.read_bytes()
    assert [entry.name for entry in tmp_path.iterdir()] == ["checkpoint"]


@pytest.mark.slow
@CLASSES
def test_deep_sea_treasure_is_learned_in_seconds(cls: type[ActorCritic]) -> None:
    """By Welch's test over 100 episodes each: better than the initial, random policy by four standard errors."""
    agent = make_agent(
        cls,
        SEA,
        num_envs=8,
        seed=1,
        utility=make_utility("linear", ("treasure", "time"), weights=[0.5, 0.5]),
        steps=16,
        learning_rate=3e-3,
        entropy_start=0.1,
        entropy_end=0.01,
        objective_scales=[20.0, 20.0],
    )
    env = make_env(SEA, 50)
    before = evaluate(agent, env, episodes=100, greedy=False).episode_utilities()
    agent.train(40_000)
    after = evaluate(agent, env, episodes=100, greedy=False).episode_utilities()
    error = math.sqrt(before.var(ddof=1) / 100 + after.var(ddof=1) / 100)
    assert after.mean() - before.mean() > 4 * error
    # Better than diving at once to the nearest treasure (0.7 after one step).
    assert after.mean() > 0.5 * 0.7 - 0.5 * 1.0


@pytest.mark.slow
@CLASSES
def test_one_waypoint_is_learned_in_300_000_steps(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, num_envs=64, steps=8)
    env = make_env(ONE_WAYPOINT, 100)
    before = evaluate(agent, env, greedy=False)
    agent.train(300_000)
    after = evaluate(agent, env, greedy=False)
    assert before.succeeded.mean() < 0.1
    assert after.succeeded.mean() > 0.4
    assert after.episode_utilities().mean() > before.episode_utilities().mean() + 2.0
