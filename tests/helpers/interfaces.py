"""Shared by the tests of the interfaces: recorded episodes, and a replay function per interface.

A replay function repeats the joint actions of :class:`RecordedEpisodes` through one interface and returns all that each
vehicle received. All replay functions must return the same, bit for bit.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np

import mo_deepdrive
from mo_deepdrive.simulation.observation import ABSENT_DISTANCE
from mo_deepdrive.simulation.state import STEER_RANGE
from mo_deepdrive.world.actions import CONTINUOUS, DISCRETE, SPEED_CHANGES
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.scenarios import SCENARIOS, VERSIONS

ACTION_TYPES = ("discrete", "discrete-16", "continuous")
SEED = 7
_AT = {entry.name: k for k, entry in enumerate(layout(SCENARIOS["intersection"]))}


class Report(NamedTuple):
    """What one vehicle receives after one decision; the first report, after the reset, has a reward of zeros."""

    observation: np.ndarray
    reward: np.ndarray
    terminated: bool = False
    truncated: bool = False
    end: str = ""


EpisodeReports = tuple[list[Report], ...]  # one list per vehicle


@dataclass(frozen=True)
class EpisodePlan:
    """How the vehicles drive in one episode, and how they end.

    Attributes:
        rules: how each vehicle drives.
        ends: why each vehicle ends.
        ends_together: the same with ``end_together=True``.
        options: reset options.
    """

    rules: tuple[DrivingRule, ...]
    ends: tuple[str, ...]
    ends_together: tuple[str, ...]
    options: dict[str, Any] | None = None


@dataclass(frozen=True)
class RecordedEpisodes:
    """Joint actions of consecutive episodes: the first is reset with SEED, the others without a seed.

    Attributes:
        arguments: arguments of the environment, besides the scenario.
        options: reset options per episode.
        actions: joint actions per episode, (decisions, vehicles) or (decisions, vehicles, 3).
        scenario: its name.
    """

    arguments: dict[str, Any]
    options: list[dict[str, Any] | None]
    actions: list[np.ndarray]
    scenario: str = "intersection"

    @property
    def vehicles(self) -> int:
        return int(self.actions[0].shape[1])

    def resets(self) -> list[tuple[dict[str, Any], np.ndarray]]:
        """The arguments of ``reset`` and the joint actions of every episode."""
        seeds = [SEED] + [None] * (len(self.actions) - 1)
        return [
            ({"seed": seed, "options": options}, actions)
            for seed, options, actions in zip(seeds, self.options, self.actions, strict=True)
        ]


# ----------------------------------------------------------------------------------------------------------- driving


def control(observation: np.ndarray, steer: float, speed: float, action_type: str) -> Any:
    """The action nearest to a steer (rad, positive to the left) and a speed (m/s); -1 m/s is a full brake."""
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


def stay(observation: np.ndarray, action_type: str) -> Any:
    return np.array([0.0, 0.0, -1.0], dtype=np.float32) if action_type == CONTINUOUS else 0


def give_way(observation: np.ndarray, action_type: str) -> Any:
    """Wait until the other vehicle has left the road, then recording."""
    alone = float(observation[_AT["other_front_left_distance"]]) == ABSENT_DISTANCE
    return (pursue if alone else stay)(observation, action_type)


def straight(observation: np.ndarray, action_type: str) -> Any:
    return control(observation, 0.0, 3.0, action_type)


def slam(observation: np.ndarray, action_type: str) -> Any:
    """Drive straight on, and brake as hard as possible when fast."""
    speed, throttle = float(observation[_AT["speed"]]), float(observation[_AT["throttle"]])
    braking = speed > 5.5 or (throttle <= 0.0 and speed > 3.0)
    return control(observation, 0.0, -1.0 if braking else 10.0, action_type)


DrivingRule = Callable[[np.ndarray, str], Any]
_AHEAD, _ONCOMING, _FAR_BEHIND = (27.077, 15.0, 0.0), (27.077, 25.0, math.pi), (27.077, -10.0, 0.0)
PLANS: dict[str, EpisodePlan] = {
    "both arrive": EpisodePlan((give_way, pursue), ("arrived", "arrived"), ("other_vehicle", "arrived")),
    "the straight one fails": EpisodePlan(
        (give_way, slam), ("arrived", "harmful_g_force"), ("other_vehicle", "harmful_g_force")
    ),
    "the left turn fails": EpisodePlan(
        (slam, pursue),
        ("harmful_g_force", "arrived"),
        ("harmful_g_force", "other_vehicle"),
        {"starts": (_FAR_BEHIND, (24.039, 45.0, math.pi))},
    ),
    "they collide": EpisodePlan(
        (straight, straight),
        ("collision", "collision"),
        ("collision", "collision"),
        {"starts": (_AHEAD, _ONCOMING)},
    ),
    "both fail in the same decision": EpisodePlan(
        (slam, slam),
        ("harmful_g_force", "harmful_g_force"),
        ("harmful_g_force", "harmful_g_force"),
        {"starts": (_FAR_BEHIND, (24.039, 60.0, math.pi))},
    ),
    "one arrives, one stays": EpisodePlan((pursue, stay), ("arrived", "time_limit"), ("arrived", "other_vehicle")),
    "both stay": EpisodePlan((stay, stay), ("time_limit", "time_limit"), ("time_limit", "time_limit")),
}


# Version 1 of the ids, and actions that arrive late.
LATE_V1 = {**VERSIONS["intersection"]["v1"], "action_delay": 2}


@functools.cache
def record(action_type: str, end_together: bool, late_v1: bool = False) -> RecordedEpisodes:
    """Drive an episode of every plan through the vector interface; cached."""
    arguments = {"action_type": action_type, "end_together": end_together, **(LATE_V1 if late_v1 else {})}
    return _driven("intersection", arguments, [(plan.rules, plan.options) for plan in PLANS.values()], action_type)


@functools.cache
def record_roundabout(vehicles: int, cars: int) -> RecordedEpisodes:
    """Drive three episodes at the roundabout without giving way: some arrive, some collide; cached."""
    arguments = {"vehicles": vehicles, "cars": cars, "time_limit": 30.0, "charge_remaining_time": True}
    return _driven("roundabout", arguments, [((pursue,) * vehicles, None)] * 3, "discrete")


def _driven(
    scenario: str, arguments: dict[str, Any], plans: list[tuple[tuple[DrivingRule, ...], Any]], action_type: str
) -> RecordedEpisodes:
    """An episode of every plan: the rules of the vehicles, and reset options."""
    env = make_vector(1, arguments, scenario)
    actions = []
    for number, (rules, options) in enumerate(plans):
        observations, _ = env.reset(seed=SEED if number == 0 else None, options=options)
        taken = []
        infos: dict[str, Any] = {}
        while "end" not in infos:
            taken.append(np.array([rule(observations[0, v], action_type) for v, rule in enumerate(rules)]))
            observations, _, _, _, infos = env.step(taken[-1][None])
        actions.append(np.array(taken))
    return RecordedEpisodes(arguments, [options for _, options in plans], actions, scenario)


# ----------------------------------------------------------------------------------------------------------- replays


def make_vector(num_envs: int, arguments: dict[str, Any], scenario: str = "intersection") -> Any:
    name = f"mo-deepdrive-{scenario}-v0"
    return gymnasium.make_vec(name, num_envs=num_envs, autoreset_mode="Disabled", **arguments)


def replay_vector(recording: RecordedEpisodes) -> list[EpisodeReports]:
    """The vector interface with one world."""
    env = make_vector(1, recording.arguments, recording.scenario)
    return [_replay_row(env, 0, actions, env.reset(**reset)[0]) for reset, actions in recording.resets()]


def replay_row(recording: RecordedEpisodes) -> list[EpisodeReports]:
    """A row of the vector interface; the other rows drive at random and are reset whenever they end."""
    row, worlds = 3, 5
    env = make_vector(worlds, recording.arguments, recording.scenario)
    env.action_space.seed(0)
    mine = np.arange(worlds) == row
    env.reset(seed=list(range(100, 100 + worlds)))
    episodes = []
    for reset, actions in recording.resets():
        seeds = [reset["seed"] if this else None for this in mine]
        observations, _ = env.reset(seed=seeds, options={"reset_mask": mine, **(reset["options"] or {})})
        episodes.append(_replay_row(env, row, actions, observations))
    return episodes


def _replay_row(env: Any, row: int, actions: np.ndarray, observations: np.ndarray) -> EpisodeReports:
    """One episode of world ``row``, which has just been reset."""
    zeros = np.zeros(env.reward_dim, dtype=np.float32)
    reports: EpisodeReports = tuple([Report(observations[row, v], zeros)] for v in range(env.vehicles))
    for joint in actions:
        batch = env.action_space.sample()
        batch[row] = joint
        observations, rewards, terminated, truncated, infos = env.step(batch)
        for v in range(env.vehicles):
            if infos["acted"][row, v]:
                end = env.batch.end_names(row)[v]
                flags = bool(terminated[row, v]), bool(truncated[row, v])
                reports[v].append(Report(observations[row, v], rewards[row, v], *flags, end))
        others = (terminated | truncated).all(axis=1)
        others[row] = False
        if others.any():
            env.reset(options={"reset_mask": others})
    return reports


def replay_turn_based(recording: RecordedEpisodes) -> list[EpisodeReports]:
    name = f"mo-deepdrive-{recording.scenario}-v0"
    env = gymnasium.make(name, disable_env_checker=True, **recording.arguments).unwrapped
    episodes = []
    for reset, actions in recording.resets():
        observation, info = env.reset(**reset)
        reports: EpisodeReports = tuple([] for _ in range(recording.vehicles))
        reports[0].append(Report(observation, np.zeros(env.reward_dim, dtype=np.float32)))
        terminated = truncated = False
        while not (terminated or truncated):
            vehicle = info["vehicle"]
            # The action of a vehicle's last turn is ignored.
            decision = min(len(reports[vehicle]), len(actions)) - 1
            observation, reward, terminated, truncated, info = env.step(actions[decision][vehicle])
            end = info.get("end", "")
            # The flags are False until the last turn of the episode, but each vehicle's flags follow from its end.
            flags = end not in ("", "time_limit"), end == "time_limit"
            assert (terminated, truncated) in (flags, (False, False))
            reports[info["vehicle"]].append(Report(observation, reward, *flags, end))
        assert (terminated, truncated) == flags
        episodes.append(reports)
    return episodes


def v0(scenario: str = "intersection") -> dict[str, Any]:
    """The arguments of the first version of a scenario, for interfaces without ids."""
    return dict(gymnasium.spec(SCENARIOS[scenario].id).kwargs)


def replay_parallel(recording: RecordedEpisodes, keep_finished: bool = False) -> list[EpisodeReports]:
    """The parallel interface: vehicles that have ended leave, or repeat their last observation, with zero rewards."""
    arguments = {**v0(recording.scenario), **recording.arguments, "keep_finished": keep_finished}
    env = mo_deepdrive.parallel_env(**arguments)
    episodes = []
    for reset, actions in recording.resets():
        reports = first_reports(env, env.reset(**reset)[0])
        for decision, joint in enumerate(actions, start=1):
            assert not keep_finished or env.agents == env.possible_agents
            returned = env.step({agent: joint[env.possible_agents.index(agent)] for agent in env.agents})
            assert all(each.keys() == returned[0].keys() for each in returned)
            for v, agent in enumerate(env.possible_agents):
                assert (agent in returned[0]) == (keep_finished or not reports[v][-1].end)
                if agent not in returned[0]:
                    continue
                observation, reward, terminated, truncated, info = (each[agent] for each in returned)
                if reports[v][-1].end:
                    assert observation.tobytes() == reports[v][-1].observation.tobytes()
                    assert not reward.any()
                    assert info == {}
                else:
                    end = info.get("end", "")
                    flags = end not in ("", "time_limit"), end == "time_limit"
                    assert info == ({"end": end, "success": end == "arrived"} if end else {})
                    reports[v].append(Report(observation, reward, *flags, end))
                own = reports[v][-1].terminated, reports[v][-1].truncated
                shown = own if decision == len(actions) or not keep_finished else (False, False)
                assert (terminated, truncated) == shown
        assert env.agents == []
        episodes.append(reports)
    return episodes


def replay_aec(recording: RecordedEpisodes) -> list[EpisodeReports]:
    env = mo_deepdrive.env(**{**v0(recording.scenario), **recording.arguments})
    episodes = []
    for reset, actions in recording.resets():
        env.reset(**reset)
        reports: EpisodeReports = tuple([] for _ in range(recording.vehicles))
        for agent in env.agent_iter():
            v = env.possible_agents.index(agent)
            observation, reward, terminated, truncated, info = env.last()
            reports[v].append(Report(observation, reward, terminated, truncated, info.get("end", "")))
            env.step(None if terminated or truncated else actions[len(reports[v]) - 1][v])
        episodes.append(reports)
    return episodes


def first_reports(env: Any, observations: dict[str, np.ndarray]) -> EpisodeReports:
    """The reports after a reset of an interface with named agents."""
    zeros = np.zeros(env.reward_dim, dtype=np.float32)
    return tuple([Report(observations[agent], zeros)] for agent in env.possible_agents)


INTERFACES: dict[str, Callable[[RecordedEpisodes], list[EpisodeReports]]] = {
    "vector": replay_vector,
    "row of a batch": replay_row,
    "turn-based": replay_turn_based,
    "parallel": replay_parallel,
    "parallel that keeps finished vehicles": functools.partial(replay_parallel, keep_finished=True),
    "AEC": replay_aec,
}
