"""Driving by hand: keys as actions, people in an environment, and a policy that drives the other vehicle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from algorithms import MOA2C
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.play import (
    END_HOLD,
    FRAMES_PER_DECISION,
    EpisodeOutcome,
    HumanPlayEnv,
    Keys,
    choose_action,
    make_play_env,
)
from mo_deepdrive.simulation.state import VEHICLE
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.world.actions import action_names

ONE, TWO = "mo-deepdrive-one-waypoint-v0", "mo-deepdrive-intersection-v0"
NOTHING, UP, DOWN = Keys(False, False, False, False), Keys(True, False, False, False), Keys(False, True, False, False)
LEFT, RIGHT = Keys(False, False, True, False), Keys(False, False, False, True)
UP_LEFT = Keys(True, False, True, False)


# ------------------------------------------------------------------------------------------------------ keys as actions


def chosen(keys: Keys, action_type: str, fields: dict[str, float]) -> str:
    """The name of the action for a vehicle whose state is zero except for ``fields``."""
    vehicle = np.zeros(1, dtype=VEHICLE)[0]
    for name, value in fields.items():
        vehicle[name] = value
    return action_names(action_type)[choose_action(keys, vehicle, action_type)]


@pytest.mark.parametrize(
    ("keys", "state", "name"),
    [
        (NOTHING, {"speed": 5.0, "steer": 0.1}, "idle"),
        (UP, {}, "decay steer, increase speed"),
        (DOWN, {"speed": 3.0}, "decay steer, decrease speed"),
        (UP_LEFT, {}, "large steer left, increase speed"),
        (Keys(False, True, False, True), {}, "large steer right, decrease speed"),
        # As far as possible at every speed.
        (LEFT, {"speed": 1.0}, "large steer left, maintain speed"),
        (LEFT, {"speed": 8.0, "steer": 0.1}, "small steer left, maintain speed"),
        (RIGHT, {"speed": 8.0, "steer": -0.1}, "small steer right, maintain speed"),
        # Back to straight without left and right.
        (UP, {"speed": 3.0, "steer": 0.1}, "micro steer left, increase speed"),
        (UP, {"speed": 3.0, "steer": 0.00174533}, "decay steer, increase speed"),
        # The car coasts without a key for the speed; opposite keys brake and steer straight.
        (LEFT, {"speed": 2.0, "throttle": 1.0}, "large steer left, decrease speed"),
        (Keys(True, True, False, False), {}, "decay steer, decrease speed"),
        (Keys(True, False, True, True), {}, "decay steer, increase speed"),
    ],
)
def test_keys_choose_actions_by_what_they_do(keys: Keys, state: dict[str, float], name: str) -> None:
    assert chosen(keys, "discrete", state) == name
    if "micro" not in name and "small" not in name:
        assert chosen(keys, "discrete-16", state) == name


# --------------------------------------------------------------------------------------------------- the environment


def make_human_env(
    env_id: str = ONE, *, seats: tuple[int, ...] = (0,), on_frame: Any = None, **arguments: Any
) -> HumanPlayEnv:
    human_env = HumanPlayEnv(make_play_env(env_id, **arguments), seats, on_frame=on_frame)
    human_env.reset(seed=1)
    return human_env


def pressed(*keys: Keys, restart: bool = False) -> NDArray[np.int8]:
    """The action for the keys that every person holds down."""
    return np.array([*(key for each in keys for key in each), restart], dtype=np.int8)


def hold(human_env: HumanPlayEnv, *keys: Keys, decisions: int = 1) -> list[dict[str, Any]]:
    """Hold keys for some decisions; returns the infos of all steps."""
    return [human_env.step(pressed(*keys))[4] for _ in range(decisions * FRAMES_PER_DECISION)]


def vehicles(human_env: HumanPlayEnv) -> Any:
    return human_env.vector_env.batch.state[0]


@pytest.mark.parametrize("action_type", ["discrete", "discrete-16", "continuous"])
def test_the_keys_drive_a_car(action_type: str) -> None:
    human_env = make_human_env(action_type=action_type)
    (car,) = vehicles(human_env)
    start = car.copy()
    hold(human_env, UP, decisions=20)
    assert 1.5 < car.speed < 2.5
    assert car.x > start.x + 1.0
    assert car.heading == pytest.approx(start.heading, abs=1e-6)
    hold(human_env, LEFT, decisions=5)
    assert car.heading > start.heading + 0.1
    heading = car.heading
    hold(human_env, RIGHT, decisions=10)
    assert car.heading < heading - 0.1
    speed = car.speed
    hold(human_env, NOTHING, decisions=5)
    assert 0.9 * speed < car.speed < speed
    hold(human_env, DOWN, decisions=10)
    assert car.speed < 0.2


def test_a_key_pressed_for_one_frame_counts_for_a_whole_decision() -> None:
    short, long = make_human_env(), make_human_env()
    for frame in range(FRAMES_PER_DECISION):
        short.step(pressed(UP if frame == 1 else NOTHING))
    hold(long, UP)
    assert vehicles(short)[0].throttle == vehicles(long)[0].throttle > 0.0
    hold(short, NOTHING)
    assert vehicles(short)[0].throttle == 0.0


def test_an_outcome_has_the_ends_and_returns_of_all_vehicles() -> None:
    human_env = make_human_env(TWO, seats=(0, 1), time_limit=2, end_together=False)
    total = np.zeros((2, human_env.vector_env.reward_dim))
    for _ in range(20 * FRAMES_PER_DECISION):
        _, rewards, terminated, truncated, info = human_env.step(pressed(UP, NOTHING))
        total += rewards
        assert not terminated
        assert not truncated
    outcome: EpisodeOutcome = info["outcome"]
    assert (outcome.episode, outcome.seed) == (1, 1)
    assert outcome.ends == ("time_limit", "time_limit")
    assert outcome.seconds == (2.0, 2.0)
    np.testing.assert_allclose(outcome.returns, total)
    distances = outcome.returns[:, human_env.vector_env.objectives.index("distance")]
    assert distances[0] > 1.0
    assert distances[1] == 0.0


def test_the_last_frame_is_held_and_the_next_episode_differs() -> None:
    human_env = make_human_env(time_limit=0.5)
    first = vehicles(human_env)[0].waypoints.copy()
    hold(human_env, UP, decisions=5)
    x = vehicles(human_env)[0].x
    for still in range(1, round(END_HOLD * 10) * FRAMES_PER_DECISION + 1):
        terminated = human_env.step(pressed(UP))[2]
        assert terminated == (still == round(END_HOLD * 10) * FRAMES_PER_DECISION)
    assert vehicles(human_env)[0].x == x
    human_env.reset()
    assert (vehicles(human_env)[0].waypoints != first).any()
    infos = hold(human_env, NOTHING, decisions=5)
    assert (infos[-1]["outcome"].episode, infos[-1]["outcome"].seed) == (2, 2)


def test_a_restarted_episode_has_the_same_scenario() -> None:
    human_env = make_human_env()
    beginning = vehicles(human_env).copy()
    hold(human_env, UP_LEFT, decisions=5)
    *_, terminated, truncated, info = human_env.step(pressed(NOTHING, restart=True))
    assert (terminated, truncated, info) == (False, True, {})
    human_env.reset()
    assert vehicles(human_env).tobytes() == beginning.tobytes()


# ----------------------------------------------------------------------------------------------------------- policies


def make_agent(**arguments: Any) -> MOA2C:
    """An agent whose policy depends on the observation."""
    env = make_env(TWO, 4, arguments)
    utility = make_utility("intersection_linear", env.unwrapped.objectives)  # type: ignore[attr-defined]
    agent = MOA2C(env, utility, steps=8, hidden=[8], learning_rate=0.01)
    agent.train(128)
    return agent


# Exactly as it does without a person in the environment.
@pytest.mark.slow
@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
@pytest.mark.parametrize("mine", [0, 1])
def test_a_policy_drives_the_other_vehicle_as_it_would_without_a_person(mine: int, action_type: str) -> None:
    agent = make_agent(action_type=action_type, time_limit=3)
    env = make_play_env(TWO, action_type=action_type, time_limit=3)
    human_env = HumanPlayEnv(env, (mine,), policy=agent, generator=torch.Generator().manual_seed(5))
    human_env.reset(seed=1)
    for _ in range(20 * FRAMES_PER_DECISION):
        human_env.step(pressed(NOTHING))
    driven = env.batch.state[0].copy()

    generator = torch.Generator().manual_seed(5)
    observations, _ = env.reset(seed=1)
    accrued_reward = AccruedReward.begin(1, 2, env.reward_dim)
    for _ in range(20):
        actions = agent.env.environment_actions(agent.act(observations, accrued_reward, generator))
        actions[0, mine] = 0 if action_type == "discrete" else (0.0, 0.0, -1.0)
        observations, rewards, *_ = env.step(actions)
        accrued_reward.add(rewards, agent.gamma)
    assert driven.tobytes() == env.batch.state[0].tobytes()
    assert driven[1 - mine].travelled > 0.0
