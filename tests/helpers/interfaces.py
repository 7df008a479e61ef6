"""Helpers of the tests of the APIs: trajectories at the intersection, recorded once, and one player per API.

A player replays the joint actions of a :class:`Drive` through one API and returns what each vehicle received in each
episode. All players must return the same, bit for bit.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

import mo_deepdrive
from mo_deepdrive.actions import CONTINUOUS, DISCRETE, SPEED_CHANGES
from mo_deepdrive.observation import ABSENT_DISTANCE, layout
from mo_deepdrive.scenarios import SCENARIOS
from mo_deepdrive.simulation.state import STEER_RANGE

ACTION_TYPES = ("discrete", "discrete-16", "continuous")
VEHICLES = 2
SEED = 7
_AT = {entry.name: k for k, entry in enumerate(layout(SCENARIOS["intersection"]))}


@dataclass(frozen=True)
class Report:
    """What one vehicle receives in one step; the first report of an episode, after the reset, has a reward of zeros."""

    observation: np.ndarray
    reward: np.ndarray
    terminated: bool = False
    truncated: bool = False
    end: str = ""


Episode = tuple[list[Report], ...]  # the reports of every vehicle


@dataclass(frozen=True)
class Plan:
    """One episode: a driver per vehicle, the reset options, and why each vehicle's episode is expected to end.

    Attributes:
        drivers: one per vehicle.
        ends: why each vehicle's episode ends.
        ends_together: the same under ``end_together=True``.
        pins: reset options.
    """

    drivers: tuple[Driver, ...]
    ends: tuple[str, ...]
    ends_together: tuple[str, ...]
    pins: dict[str, Any] | None = None


@dataclass(frozen=True)
class Drive:
    """Joint actions of consecutive episodes: the first is reset with SEED, the others without a seed.

    Attributes:
        arguments: of the environment, besides the scenario.
        pins: reset options per episode.
        actions: joint actions per episode, (decisions, vehicles) or (decisions, vehicles, 3).
    """

    arguments: dict[str, Any]
    pins: list[dict[str, Any] | None]
    actions: list[np.ndarray]

    def resets(self) -> list[tuple[dict[str, Any], np.ndarray]]:
        """The arguments of ``reset`` and the joint actions of each episode."""
        seeds = [SEED] + [None] * (len(self.actions) - 1)
        return [
            ({"seed": seed, "options": pins}, actions)
            for seed, pins, actions in zip(seeds, self.pins, self.actions, strict=True)
        ]


# ----------------------------------------------------------------------------------------------------------- drivers


def control(observation: np.ndarray, steer: float, speed: float, action_type: str) -> Any:
    """The action closest to a steer (rad, positive to the left) and a speed (m/s); -1 m/s brakes fully."""
    now = float(observation[_AT["speed"]])
    if action_type == CONTINUOUS:
        brake = 1.0 if speed < 0.0 else -1.0
        return np.array([steer / STEER_RANGE, 0.6 * np.clip(speed - now, -1.0, 1.0), brake], dtype=np.float32)
    held = float(observation[_AT["steer"]])
    targets = [s.decay * held + s.offset + s.curl / max(now, 1.0) ** 2 for s in DISCRETE[action_type]]
    group = int(np.argmin(np.abs(np.array(targets) - steer)))
    change = "increase speed" if now < speed else "decrease speed" if now > speed + 0.3 else "maintain speed"
    return 1 + 3 * group + list(SPEED_CHANGES.values()).index(change)


def pursue(observation: np.ndarray, action_type: str) -> Any:
    """Drive gently to the next waypoint."""
    angle, speed = float(observation[_AT["next_angle"]]), float(observation[_AT["speed"]])
    steer = np.clip(-angle, -1.0, 1.0) * 0.6 / max(1.0, speed) ** 2 * STEER_RANGE
    return control(observation, steer, 3.0 if abs(angle) < 0.3 else 1.5, action_type)


def stand(observation: np.ndarray, action_type: str) -> Any:
    """Stay at rest."""
    return np.array([0.0, 0.0, -1.0], dtype=np.float32) if action_type == CONTINUOUS else 0


def give_way(observation: np.ndarray, action_type: str) -> Any:
    """Wait until the other vehicle has left the road, then drive."""
    alone = float(observation[_AT["other_front_left_distance"]]) == ABSENT_DISTANCE
    return (pursue if alone else stand)(observation, action_type)


def straight(observation: np.ndarray, action_type: str) -> Any:
    """Drive straight on."""
    return control(observation, 0.0, 3.0, action_type)


def slam(observation: np.ndarray, action_type: str) -> Any:
    """Drive straight on, and brake as hard as possible at high speed."""
    speed, throttle = float(observation[_AT["speed"]]), float(observation[_AT["throttle"]])
    braking = speed > 5.5 or (throttle <= 0.0 and speed > 3.0)
    return control(observation, 0.0, -1.0 if braking else 10.0, action_type)


Driver = Callable[[np.ndarray, str], Any]
_AHEAD, _ONCOMING, _FAR_BEHIND = (27.077, 15.0, 0.0), (27.077, 25.0, math.pi), (27.077, -10.0, 0.0)
PLANS: dict[str, Plan] = {
    "both arrive": Plan((give_way, pursue), ("arrived", "arrived"), ("other_vehicle", "arrived")),
    "the straight one fails": Plan(
        (give_way, slam), ("arrived", "harmful_g_force"), ("other_vehicle", "harmful_g_force")
    ),
    "the left turn fails": Plan(
        (slam, pursue),
        ("harmful_g_force", "arrived"),
        ("harmful_g_force", "other_vehicle"),
        {"starts": (_FAR_BEHIND, (24.039, 45.0, math.pi))},
    ),
    "they collide": Plan(
        (straight, straight),
        ("collision", "collision"),
        ("collision", "collision"),
        {"starts": (_AHEAD, _ONCOMING)},
    ),
    "both fail in the same decision": Plan(
        (slam, slam),
        ("harmful_g_force", "harmful_g_force"),
        ("harmful_g_force", "harmful_g_force"),
        {"starts": (_FAR_BEHIND, (24.039, 60.0, math.pi))},
    ),
    "one arrives, one stands": Plan((pursue, stand), ("arrived", "time_limit"), ("arrived", "other_vehicle")),
    "both stand": Plan((stand, stand), ("time_limit", "time_limit"), ("time_limit", "time_limit")),
}


@functools.cache
def record(action_type: str, end_together: bool) -> Drive:
    """Record every plan in the vector environment, once."""
    arguments = {"action_type": action_type, "end_together": end_together}
    env = make_vector(1, arguments)
    actions = []
    for number, plan in enumerate(PLANS.values()):
        observations, _ = env.reset(seed=SEED if number == 0 else None, options=plan.pins)
        taken = []
        infos: dict[str, Any] = {}
        while "end" not in infos:
            joint = [driver(observations[0, v], action_type) for v, driver in enumerate(plan.drivers)]
            taken.append(np.array(joint))
            observations, _, _, _, infos = env.step(taken[-1][None])
        actions.append(np.array(taken))
    return Drive(arguments, [plan.pins for plan in PLANS.values()], actions)


# ----------------------------------------------------------------------------------------------------------- players


def make_vector(num_envs: int, arguments: dict[str, Any]) -> Any:
    """The vector environment of the intersection, without autoreset."""
    return gymnasium.make_vec("mo-deepdrive-intersection-v0", num_envs=num_envs, autoreset_mode="Disabled", **arguments)


def play_vector(drive: Drive) -> list[Episode]:
    """The vector environment with one copy."""
    env = make_vector(1, drive.arguments)
    return [_play_row(env, 0, actions, env.reset(**reset)[0]) for reset, actions in drive.resets()]


def play_row(drive: Drive) -> list[Episode]:
    """One row of the vector environment; the other rows take random actions and are reset whenever they end."""
    row, worlds = 3, 5
    env = make_vector(worlds, drive.arguments)
    env.action_space.seed(0)
    mine = np.arange(worlds) == row
    env.reset(seed=list(range(100, 100 + worlds)))
    episodes = []
    for reset, actions in drive.resets():
        seeds = [reset["seed"] if this else None for this in mine]
        observations, _ = env.reset(seed=seeds, options={"reset_mask": mine, **(reset["options"] or {})})
        episodes.append(_play_row(env, row, actions, observations))
    return episodes


def _play_row(env: Any, row: int, actions: np.ndarray, observations: np.ndarray) -> Episode:
    """One episode of environment ``row``, which has just been reset."""
    zeros = np.zeros(env.reward_dim, dtype=np.float32)
    reports: Episode = tuple([Report(observations[row, v], zeros)] for v in range(VEHICLES))
    for joint in actions:
        batch = env.action_space.sample()
        batch[row] = joint
        observations, rewards, terminated, truncated, infos = env.step(batch)
        for v in range(VEHICLES):
            if infos["acted"][row, v]:
                end = env.batch.end_names(row)[v]
                flags = bool(terminated[row, v]), bool(truncated[row, v])
                reports[v].append(Report(observations[row, v], rewards[row, v], *flags, end))
        others = (terminated | truncated).all(axis=1)
        others[row] = False
        if others.any():
            env.reset(options={"reset_mask": others})
    return reports


def play_turn_based(drive: Drive) -> list[Episode]:
    """The turn-based Gymnasium API."""
    env = gymnasium.make("mo-deepdrive-intersection-v0", disable_env_checker=True, **drive.arguments).unwrapped
    episodes = []
    for reset, actions in drive.resets():
        observation, info = env.reset(**reset)
        reports: Episode = ([Report(observation, np.zeros(env.reward_dim, dtype=np.float32))], [])
        terminated = truncated = False
        while not (terminated or truncated):
            vehicle = info["vehicle"]
            # The answer to a vehicle's last turn is ignored.
            decision = min(len(reports[vehicle]), len(actions)) - 1
            observation, reward, terminated, truncated, info = env.step(actions[decision][vehicle])
            end = info.get("end", "")
            # The flags are False until the last turn of the episode; those of a vehicle follow from why it ended.
            flags = end not in ("", "time_limit"), end == "time_limit"
            assert (terminated, truncated) in (flags, (False, False))
            reports[info["vehicle"]].append(Report(observation, reward, *flags, end))
        assert (terminated, truncated) == flags
        episodes.append(reports)
    return episodes


def play_parallel(drive: Drive) -> list[Episode]:
    """The parallel API, in which vehicles leave when their episode ends."""
    env = mo_deepdrive.parallel_env(**drive.arguments)
    episodes = []
    for reset, actions in drive.resets():
        reports = begin(env, env.reset(**reset)[0])
        for joint in actions:
            told = env.step({agent: joint[env.possible_agents.index(agent)] for agent in env.agents})
            for v, agent in enumerate(env.possible_agents):
                if agent in told[0]:
                    observation, reward, terminated, truncated, info = (each[agent] for each in told)
                    reports[v].append(Report(observation, reward, terminated, truncated, info.get("end", "")))
        assert env.agents == []
        episodes.append(reports)
    return episodes


def play_kept(drive: Drive) -> list[Episode]:
    """The parallel API that keeps finished vehicles, with their last observation and a reward of zeros."""
    env = mo_deepdrive.parallel_env(keep_finished=True, **drive.arguments)
    episodes = []
    for reset, actions in drive.resets():
        reports = begin(env, env.reset(**reset)[0])
        for decision, joint in enumerate(actions, start=1):
            assert env.agents == env.possible_agents
            told = env.step(dict(zip(env.agents, joint, strict=True)))
            last = decision == len(actions)
            for v, agent in enumerate(env.possible_agents):
                observation, reward, terminated, truncated, info = (each[agent] for each in told)
                if reports[v][-1].end:
                    assert observation.tobytes() == reports[v][-1].observation.tobytes()
                    assert not reward.any()
                    assert info == {}
                else:
                    end = info.get("end", "")
                    flags = end not in ("", "time_limit"), end == "time_limit"
                    reports[v].append(Report(observation, reward, *flags, end))
                own = reports[v][-1].terminated, reports[v][-1].truncated
                assert (terminated, truncated) == (own if last else (False, False))
        assert env.agents == []
        episodes.append(reports)
    return episodes


def play_aec(drive: Drive) -> list[Episode]:
    """The AEC API."""
    env = mo_deepdrive.env(**drive.arguments)
    episodes = []
    for reset, actions in drive.resets():
        env.reset(**reset)
        reports: Episode = tuple([] for _ in range(VEHICLES))
        for agent in env.agent_iter():
            v = env.possible_agents.index(agent)
            observation, reward, terminated, truncated, info = env.last()
            reports[v].append(Report(observation, reward, terminated, truncated, info.get("end", "")))
            env.step(None if terminated or truncated else actions[len(reports[v]) - 1][v])
        episodes.append(reports)
    return episodes


def begin(env: Any, observations: dict[str, np.ndarray]) -> Episode:
    """The reports after a reset of an API with named agents."""
    zeros = np.zeros(env.reward_dim, dtype=np.float32)
    return tuple([Report(observations[agent], zeros)] for agent in env.possible_agents)


FACES: dict[str, Callable[[Drive], list[Episode]]] = {
    "vector": play_vector,
    "row of a batch": play_row,
    "turn-based": play_turn_based,
    "parallel": play_parallel,
    "parallel that keeps finished vehicles": play_kept,
    "AEC": play_aec,
}


def assert_same(episodes: list[Episode], others: list[Episode]) -> None:
    """Assert that both hold the same reports, with observations and rewards equal bit for bit."""
    assert len(episodes) == len(others)
    for episode, other in zip(episodes, others, strict=True):
        for vehicle, (mine, theirs) in enumerate(zip(episode, other, strict=True)):
            assert [report.end for report in mine] == [report.end for report in theirs], vehicle
            for one, two in zip(mine, theirs, strict=True):
                assert one.observation.dtype == two.observation.dtype == np.float32
                assert one.reward.dtype == two.reward.dtype == np.float32
                assert one.observation.tobytes() == two.observation.tobytes()
                assert one.reward.tobytes() == two.reward.tobytes()
                assert (one.terminated, one.truncated) == (two.terminated, two.truncated)
                assert type(one.terminated) is type(two.terminated) is bool
