"""The collection loop against single environments that replay it, and against plain recurrences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import gymnasium
import mo_gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from algorithms.learning.collector import Collector, EnvWorlds, Running
from algorithms.learning.storage import EpisodeSums, RolloutStorage
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.policy import AccruedReward
from tests.helpers.agents import INTERSECTION, ONE_WAYPOINT, SEA, STATIC_OBSTACLE
from tests.helpers.toy_env import toy_worlds

Act = Callable[[np.ndarray, AccruedReward], np.ndarray]
GAMMA = 0.95
SEED = 2**32 + 17
DESTINATION = 1  # index of this objective in every scenario of ours


def random_policy(adapter: EnvAdapter) -> Act:
    rng = np.random.default_rng(0)
    shape = (adapter.num_envs, adapter.vehicles)

    def act(observations: np.ndarray, accrued_reward: AccruedReward) -> np.ndarray:
        if adapter.continuous:
            return rng.normal(0.0, 1.5, (*shape, adapter.actions)).astype(np.float32)
        return rng.integers(0, adapter.actions, shape)

    return act


def reflex(adapter: EnvAdapter) -> Act:
    """As good as random, but decided by what the policy is shown."""

    def act(observations: np.ndarray, accrued_reward: AccruedReward) -> np.ndarray:
        seen = np.concatenate(
            [observations, accrued_reward.value, accrued_reward.discounts[..., None]], axis=-1, dtype=np.float64
        )
        noise = np.sin(1e4 * np.abs(seen).sum(-1))
        if adapter.continuous:
            return np.stack([noise * (k + 1) % 1.0 for k in range(adapter.actions)], axis=-1).astype(np.float32)
        return np.floor((noise + 1) / 2.001 * adapter.actions).astype(np.int64)

    return act


def half_drive(adapter: EnvAdapter) -> Act:
    """Every other vehicle drives to its waypoint at walking pace, so that some episodes succeed; the rest is random.

    A driver takes "small steer left", "small steer right" or "decay steer", and "increase speed" below 4 m/s.
    """
    at_random = random_policy(adapter)

    def act(observations: np.ndarray, accrued_reward: AccruedReward) -> np.ndarray:
        angle, speed = observations[..., 0], observations[..., 11]
        group = np.where(angle > 0.05, 2, np.where(angle < -0.05, 1, 0))
        actions = 1 + 3 * group + np.where(speed < 4.0, 2, 0)
        actions[1::2] = at_random(observations, accrued_reward)[1::2]
        return actions

    return act


def one_waits(adapter: EnvAdapter) -> Act:
    """In Intersection: the vehicle that goes straight on drives off, the other stands still."""

    def act(observations: np.ndarray, accrued_reward: AccruedReward) -> np.ndarray:
        return np.tile([0, 3], (adapter.num_envs, 1))

    return act


class Drives:
    """Drives by what arrays say; actors would see what the environment gives."""

    def __init__(self, act: Act, input_size: int):
        self.act, self.input_size = act, input_size

    def inputs(self, observations: torch.Tensor, *_: Any) -> torch.Tensor:
        return observations

    def decide(self, t: int, at: RolloutStorage, now: Running) -> None:
        del t
        at.actions[0] = torch.from_numpy(self.act(*now.arrays(0)))


def collector_of(adapter: EnvAdapter, act: Act, steps: int, seed: int = SEED) -> Collector:
    sums = EpisodeSums(1, adapter.vehicles, adapter.objectives, [], torch.device("cpu"))
    drives, shape = Drives(act, adapter.observation_size), (1, steps, adapter.num_envs)
    collector = Collector(drives, adapter, EnvWorlds(adapter, seed), shape, 1, sums, static=False)
    collector.accrued_discounts[:] = GAMMA
    collector.reset()
    return collector


def rollout_of(collector: Collector) -> tuple[SimpleNamespace, SimpleNamespace]:
    """The next rollout, and the episodes that ended in it."""
    collector.collect()
    storage = SimpleNamespace(**{name: each[0].clone() for name, each in vars(collector.storage).items()})
    ended = storage.ended.numpy()
    succeeded, lengths, *returns = np.moveaxis(storage.ended_sums.numpy()[ended], -1, 0)
    episodes = SimpleNamespace(
        vehicles=np.nonzero(ended)[2],
        returns=np.stack(returns, axis=-1),
        discounted=storage.ended_values.numpy()[ended],
        lengths=lengths,
        succeeded=succeeded.astype(bool),
    )
    return storage, episodes


@dataclass
class Collected:
    """Several successive rollouts and the episodes that ended in them."""

    env: EnvAdapter
    rollouts: list[SimpleNamespace]
    parts: list[SimpleNamespace]

    def all(self, name: str) -> np.ndarray:
        """A field over all rollouts, time-major; of the fields with T + 1 rows the first T."""
        return np.concatenate([getattr(rollout, name)[: len(rollout.rewards)].numpy() for rollout in self.rollouts])

    @property
    def over(self) -> np.ndarray:
        return self.all("terminated") | self.all("truncated")

    def episodes(self, name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in self.parts])


def collect(
    env_id: str,
    *,
    num_envs: int = 4,
    steps: int = 40,
    rollouts: int = 3,
    policy: Callable[[EnvAdapter], Act] = random_policy,
    **arguments: Any,
) -> Collected:
    adapter = EnvAdapter(make_env(env_id, num_envs, arguments))
    collector = collector_of(adapter, policy(adapter), steps)
    collected = Collected(adapter, [], [])
    for _ in range(rollouts):
        rollout, episodes = rollout_of(collector)
        collected.rollouts.append(rollout)
        collected.parts.append(episodes)
    return collected


# Short episodes, so that some are cut off by time; where a driver shall arrive they last longer.
SITUATIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "one_waypoint": (ONE_WAYPOINT, {"time_limit": 11.0, "rollouts": 8}),
    "one_waypoint, arriving": (ONE_WAYPOINT, {"policy": half_drive, "time_limit": 9.0, "rollouts": 6}),
    "one_waypoint, continuous": (ONE_WAYPOINT, {"action_type": "continuous", "time_limit": 3.0}),
    "static_obstacle": (STATIC_OBSTACLE, {"time_limit": 11.0, "rollouts": 8}),
    "static_obstacle, arriving": (STATIC_OBSTACLE, {"policy": half_drive, "time_limit": 9.0, "rollouts": 6}),
    "static_obstacle, continuous": (STATIC_OBSTACLE, {"action_type": "continuous", "time_limit": 3.0}),
    "intersection": (INTERSECTION, {"time_limit": 15.0, "rollouts": 8}),
    "intersection, arriving": (INTERSECTION, {"policy": one_waits, "time_limit": 10.0, "rollouts": 6}),
    "intersection, continuous": (INTERSECTION, {"action_type": "continuous", "time_limit": 3.0}),
    "intersection, together": (INTERSECTION, {"end_together": True, "time_limit": 15.0, "rollouts": 8}),
    "deep-sea-treasure": (SEA, {"max_episode_steps": 12}),
    "minecart": ("minecart-deterministic-v0", {"max_episode_steps": 30}),
}
ALL = pytest.mark.parametrize("situation", SITUATIONS)
TWO_VEHICLES = pytest.mark.parametrize("situation", [s for s in SITUATIONS if s.startswith("intersection")])
OURS = pytest.mark.parametrize("situation", [s for s in SITUATIONS if "deepdrive" in SITUATIONS[s][0]])
FOREIGN = pytest.mark.parametrize("situation", ["deep-sea-treasure", "minecart"])


@pytest.fixture(scope="module")
def collected() -> Callable[[str], Collected]:
    """What was collected in a situation, once for all tests."""
    known: dict[str, Collected] = {}

    def get(situation: str) -> Collected:
        if situation not in known:
            env_id, arguments = SITUATIONS[situation]
            known[situation] = collect(env_id, **arguments)
        return known[situation]

    return get


@ALL
def test_the_cases_contain_the_events_that_the_other_tests_need(
    collected: Callable[[str], Collected], situation: str
) -> None:
    c = collected(situation)
    counted = c.over & c.all("acted")
    assert counted.sum() > 3
    if situation != "intersection, together":
        assert c.all("truncated").any()
    if situation != "minecart":
        assert (c.all("terminated") & c.all("acted")).any()
    if "arriving" in situation:
        arrived = c.all("rewards")[counted][:, DESTINATION]
        assert 0 < arrived.sum() < len(arrived)
    if c.env.vehicles == 2 and "together" not in situation:
        assert not c.all("acted").all()


@pytest.mark.slow
@ALL
def test_accrued_rewards_and_discounts_follow_their_recurrence_and_reset_after_every_episode(
    collected: Callable[[str], Collected], situation: str
) -> None:
    c = collected(situation)
    rewards, acted, over = c.all("rewards").astype(np.float64), c.all("acted"), c.over
    accrued, discounts = c.all("accrued"), c.all("discounts")
    steps, n, v, d = rewards.shape
    for i in range(n):
        for k in range(v):
            total, age = np.zeros(d), 0
            for t in range(steps):
                np.testing.assert_allclose(discounts[t, i, k], GAMMA**age, rtol=1e-4)
                np.testing.assert_allclose(accrued[t, i, k], total, rtol=1e-4, atol=1e-4)
                if over[t, i, k] or not acted[t, i, k]:
                    total, age = np.zeros(d), 0
                else:
                    total, age = total + GAMMA**age * rewards[t, i, k], age + 1


@FOREIGN
def test_a_single_copy_of_another_environment_replays_all_but_the_masked_steps(
    collected: Callable[[str], Collected], situation: str
) -> None:
    c = collected(situation)
    env_id, arguments = SITUATIONS[situation]
    single = mo_gymnasium.make(env_id, **arguments)
    acted = c.all("acted")
    ended = []
    for i in range(c.env.num_envs):
        observation, _ = single.reset(seed=SEED + i)
        returns, length = np.zeros(len(c.env.objectives)), 0
        for t in range(len(acted)):
            if not acted[t, i, 0]:
                observation, _ = single.reset()
                continue
            np.testing.assert_array_equal(c.all("inputs")[t, i, 0], observation.astype(np.float32))
            observation, reward, terminated, truncated, _ = single.step(int(c.all("actions")[t, i, 0]))
            np.testing.assert_array_equal(c.all("rewards")[t, i, 0], np.float32(reward))
            assert (c.all("terminated")[t, i, 0], c.all("truncated")[t, i, 0]) == (terminated, truncated)
            returns, length = returns + reward, length + 1
            if truncated:
                np.testing.assert_array_equal(c.all("final_inputs")[t, i, 0], observation.astype(np.float32))
            if terminated or truncated:
                ended.append((t, i, returns, length))
                returns, length = np.zeros(len(c.env.objectives)), 0
    ended.sort(key=lambda episode: episode[:2])
    np.testing.assert_array_equal(c.episodes("lengths"), [episode[3] for episode in ended])
    np.testing.assert_allclose(c.episodes("returns"), [episode[2] for episode in ended], rtol=1e-5, atol=1e-5)


@TWO_VEHICLES
def test_a_vehicle_that_has_left_the_road_is_masked_until_the_reset(
    collected: Callable[[str], Collected], situation: str
) -> None:
    c = collected(situation)
    acted, over, truncated = c.all("acted"), c.over, c.all("truncated")
    steps, n, v = acted.shape
    for i in range(n):
        on_road = [True] * v
        for t in range(steps):
            assert acted[t, i].tolist() == on_road
            for k in range(v):
                # An end is reported once, in the step in which it happens.
                assert not (over[t, i, k] and not on_road[k])
                on_road[k] = on_road[k] and not over[t, i, k]
            if not any(on_road):
                on_road = [True] * v
    masked = ~acted
    assert not c.all("rewards")[masked].any()
    assert not c.all("accrued")[masked].any()
    assert (c.all("discounts")[masked] == 1.0).all()
    assert not (truncated & c.all("terminated")).any()


@pytest.mark.slow
@TWO_VEHICLES
def test_two_vehicles_replay_the_rollout_including_final_observations(
    collected: Callable[[str], Collected], situation: str
) -> None:
    c = collected(situation)
    env_id, arguments = SITUATIONS[situation]
    options = {name: value for name, value in arguments.items() if name not in ("policy", "rollouts")}
    actions, over = c.all("actions"), c.over
    for i in range(c.env.num_envs):
        alone = gymnasium.make_vec(env_id, num_envs=1, autoreset_mode=AutoresetMode.DISABLED, **options)
        observation, _ = alone.reset(seed=SEED + i)
        for t in range(len(actions)):
            np.testing.assert_array_equal(c.all("inputs")[t, i], observation[0])
            observation, reward, terminated, truncated, _ = alone.step(actions[t, i][None])
            np.testing.assert_array_equal(c.all("rewards")[t, i], reward[0])
            for k in np.flatnonzero(c.all("truncated")[t, i]):
                np.testing.assert_array_equal(c.all("final_inputs")[t, i, k], observation[0, k])
            if (terminated | truncated).all():
                assert over[t, i].any()
                observation, _ = alone.reset()


@dataclass
class Plain:
    """One episode, accumulated from the steps of a rollout."""

    vehicle: int
    returns: np.ndarray
    discounted: np.ndarray
    length: int
    last_reward: np.ndarray


def plain_episodes(c: Collected) -> list[Plain]:
    rewards, acted, over = c.all("rewards").astype(np.float64), c.all("acted"), c.over
    steps, n, v, d = rewards.shape
    running: dict[tuple[int, int], list[np.ndarray]] = {}
    episodes = []
    for t in range(steps):
        for i in range(n):
            for k in range(v):
                if not acted[t, i, k]:
                    continue
                running.setdefault((i, k), []).append(rewards[t, i, k])
                if over[t, i, k]:
                    path = np.array(running.pop((i, k)))
                    discounted = (GAMMA ** np.arange(len(path)) @ path).reshape(d)
                    episodes.append(Plain(k, path.sum(axis=0), discounted, len(path), path[-1]))
    return episodes


@ALL
def test_episodes_are_the_sums_of_their_steps_in_the_order_of_their_ends(
    collected: Callable[[str], Collected], situation: str
) -> None:
    c = collected(situation)
    expected = plain_episodes(c)
    np.testing.assert_array_equal(c.episodes("vehicles"), [episode.vehicle for episode in expected])
    np.testing.assert_array_equal(c.episodes("lengths"), [episode.length for episode in expected])
    for name in ("returns", "discounted"):
        plain = np.array([getattr(episode, name) for episode in expected])
        np.testing.assert_allclose(c.episodes(name), plain, rtol=1e-4, atol=1e-3)


@OURS
def test_an_episode_has_succeeded_if_its_vehicle_arrived(collected: Callable[[str], Collected], situation: str) -> None:
    c = collected(situation)
    arrived = [episode.last_reward[DESTINATION] == 1.0 for episode in plain_episodes(c)]
    np.testing.assert_array_equal(c.episodes("succeeded"), arrived)


def started(env_id: str, arguments: dict[str, Any], seed: int = SEED) -> Collector:
    options = {name: value for name, value in arguments.items() if name not in ("policy", "rollouts")}
    adapter = EnvAdapter(make_env(env_id, 4, options))
    return collector_of(adapter, reflex(adapter), 17, seed)


@OURS
@pytest.mark.parametrize("rollouts", [0, 1, 3])
def test_a_collector_resumes_exactly_from_the_state_of_another(situation: str, rollouts: int) -> None:
    first = started(*SITUATIONS[situation])
    for _ in range(rollouts):
        first.collect()
    state = {name: tensor.clone() for name, tensor in first.get_state(0).items()}
    second = started(*SITUATIONS[situation], seed=3)
    second.collect()
    second.set_state([state], 4 * 17 * rollouts)
    for _ in range(4):
        one, ended = rollout_of(first)
        other, also_ended = rollout_of(second)
        for name, tensor in vars(one).items():
            kept = {"final_inputs": one.truncated, "ended_sums": one.ended}.get(name, slice(None))
            assert torch.equal(tensor[kept], getattr(other, name)[kept]), name
        for name, array in vars(ended).items():
            np.testing.assert_array_equal(array, getattr(also_ended, name), err_msg=name)


def test_episodes_of_other_environments_end_and_succeed_as_these_say() -> None:
    adapter = toy_worlds(spaces.Discrete(2))
    rollout, episodes = rollout_of(collector_of(adapter, random_policy(adapter), 8, seed=0))
    assert rollout.acted[:, 0, 0].tolist() == [True, True, True, False, True, True, True, False]
    assert episodes.succeeded.tolist() == [True] * 4
    assert episodes.lengths.tolist() == [3] * 4
