"""The RLlib environment; needs a separate virtual environment: `make test-ray`."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import mo_gymnasium
import numpy as np
import pytest
from mo_gymnasium.wrappers import LinearReward

import mo_deepdrive  # noqa: F401  (registers the ids)
from mo_deepdrive.envs.parallel import DrivingParallelEnv
from mo_deepdrive.utilities import make_utility
from tests.helpers.equality import assert_equal
from tests.helpers.interfaces import (
    ACTION_TYPES,
    EpisodeReports,
    RecordedEpisodes,
    Report,
    first_reports,
    record,
    replay_parallel,
    v0,
)

pytest.importorskip("ray.rllib", reason="Ray is not installed: make test-ray")

from collections.abc import Callable, Iterator

from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.utils.pre_checks.env import check_multiagent_environments
from ray.tune.registry import register_env

from mo_deepdrive.envs.rllib import DrivingMultiAgentEnv

VEHICLES = ["vehicle_0", "vehicle_1"]
CONFIGS: list[dict[str, Any]] = [
    {},
    {"end_together": True},
    {"action_type": "continuous", "cost_sign": "paper"},
    {"scenario": "one_waypoint", "utility": "one_waypoint_nonlinear"},
    {"scenario": "static_obstacle", "action_type": "discrete-16"},
    {"scenario": "roundabout", "vehicles": 5},
    {"scenario": "roundabout_solo", "utility": "roundabout_linear"},
]


def play(env: Any, seed: int) -> Iterator[tuple[dict[str, Any], Any]]:
    """One episode of random actions: the joint actions and the results of its steps."""
    env.reset(seed=seed)
    generator = np.random.default_rng(seed)
    while env.agents:
        actions = {}
        for agent in env.agents:
            space = env.action_spaces[agent]
            actions[agent] = generator.uniform(-1, 1, 3) if space.shape else int(generator.integers(space.n))
        yield actions, env.step(actions)


# -------------------------------------------------------------------------------------------------------- environment


@pytest.mark.parametrize("config", CONFIGS)
def test_rllibs_checker_passes(config: dict[str, Any]) -> None:
    check_multiagent_environments(DrivingMultiAgentEnv(config))


@pytest.mark.parametrize("config", CONFIGS)
def test_the_reward_is_the_utility_of_the_vector_reward(config: dict[str, Any]) -> None:
    env = DrivingMultiAgentEnv(config)
    name = config.get("utility", f"{config.get('scenario', 'intersection')}_linear")
    utility = make_utility(name, env.objectives, config.get("cost_sign", "maximise"))
    for _, (observations, rewards, _, _, infos) in play(env, seed=3):
        assert observations.keys() == rewards.keys() == infos.keys()
        for agent, reward in rewards.items():
            vector = infos[agent]["vector_reward"]
            assert vector.dtype == np.float32
            assert env.reward_spaces[agent].contains(vector)
            assert env.get_observation_space(agent).contains(observations[agent])
            assert type(reward) is float
            assert reward == float(utility(vector))


def test_every_vehicle_can_have_its_own_utility() -> None:
    weights = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    env = DrivingMultiAgentEnv(
        {
            "utility": {
                "vehicle_0": "intersection_nonlinear",
                "vehicle_1": {"name": "linear", "arguments": {"weights": weights}},
            }
        }
    )
    nonlinear = make_utility("intersection_nonlinear", env.objectives)
    for _, (_, rewards, _, _, infos) in play(env, seed=0):
        if "vehicle_0" in rewards:
            assert rewards["vehicle_0"] == float(nonlinear(infos["vehicle_0"]["vector_reward"]))
        if "vehicle_1" in rewards:
            assert rewards["vehicle_1"] == pytest.approx(float(infos["vehicle_1"]["vector_reward"] @ weights), rel=1e-5)


def replay_rllib(recording: RecordedEpisodes) -> list[EpisodeReports]:
    """The RLlib interface, which removes vehicles when they end."""
    env = DrivingMultiAgentEnv({**v0(), **recording.arguments})
    episodes = []
    for reset, actions in recording.resets():
        reports = first_reports(env, env.reset(**reset)[0])
        for joint in actions:
            results = env.step({agent: joint[env.possible_agents.index(agent)] for agent in env.agents})
            observations, _, terminateds, truncateds, infos = results
            for v, agent in enumerate(env.possible_agents):
                if agent in observations:
                    flags = terminateds[agent], truncateds["__all__"] and not terminateds[agent]
                    info = infos[agent]
                    reports[v].append(Report(observations[agent], info["vector_reward"], *flags, info.get("end", "")))
        assert env.agents == []
        episodes.append(reports)
    return episodes


@pytest.mark.parametrize("end_together", [False, True])
@pytest.mark.parametrize("action_type", ACTION_TYPES)
def test_trajectories_are_those_of_the_parallel_environment_bit_for_bit(action_type: str, end_together: bool) -> None:
    recording = record(action_type, end_together)
    assert_equal(replay_rllib(recording), replay_parallel(recording))


# ---------------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"utlity": "intersection_linear"}, "'utlity'.* did you mean 'utility'"),
        ({"keep_finished": True}, "unknown key 'keep_finished'"),
        ({"scenario": "crossroads"}, "'scenario' = 'crossroads'"),
        ({"time_limit": "long"}, "'time_limit' = 'long'"),
        ({"render_mode": "ascii"}, "render_mode = 'ascii'"),
        ({"utility": "intersection_linaer"}, "'intersection_linaer' is unknown; did you mean 'intersection_linear'"),
        ({"utility": "roundabout_linear"}, "needs near_miss, .*; the environment has .*lane_violation"),
        ({"objectives": ["distance", "collision"]}, "'intersection_linear' needs destination"),
        ({"utility": 3}, "utility = 3 must be"),
        ({"utility": "linear"}, "needs the argument 'weights'"),
        ({"utility": {"name": "linear", "arguments": {"weights": [1.0, 2.0]}}}, "must be 7 finite numbers"),
        ({"utility": {"name": "linear", "weights": [1.0]}}, "'weights' is unknown; known: arguments, name"),
        ({"utility": {"vehicle_0": "intersection_linear"}}, "utility is missing for 'vehicle_1'"),
        ({"utility": {"vehicle_0": "intersection_linear", "vehicle_1": 3}}, "utility of vehicle_1 = 3 must be"),
        ({"utility": {"vehicle_0": "intersection_linear", "vehicle_2": "linear"}}, "'vehicle_2', which is unknown"),
        ({"utility": "numpy:sqrt"}, "gives shape .* expected a number"),
    ],
)
def test_an_invalid_config_is_refused(config: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DrivingMultiAgentEnv(config)


def test_without_ray_the_import_names_the_extra(run_python: Callable[[str], str]) -> None:
    snippet = (
        "import sys\n"
        "sys.modules['ray'] = None\n"
        "import mo_deepdrive\n"
        "try:\n"
        "    import mo_deepdrive.envs.rllib\n"
        "except ImportError as error:\n"
        "    print(error)\n"
    )
    assert "pip install --editable '.[rllib]'" in run_python(snippet)


# --------------------------------------------------------------------------------------------------- RLlib's machinery


def recorded(env: DrivingMultiAgentEnv, seed: int) -> MultiAgentEpisode:
    """One episode of random actions as RLlib records it."""
    observations, infos = env.reset(seed=seed)
    episode = MultiAgentEpisode(
        observation_space=env.observation_spaces,
        action_space=env.action_spaces,
        agent_to_module_mapping_fn=lambda agent, episode: agent,
    )
    episode.add_env_reset(observations=observations, infos=infos)
    for actions, (observations, rewards, terminateds, truncateds, infos) in play(env, seed):
        episode.add_env_step(observations, actions, rewards, infos, terminateds=terminateds, truncateds=truncateds)
    return episode


@pytest.mark.parametrize("time_limit", [2.0, 9.0])
def test_rllib_bootstraps_at_the_time_limit_and_nowhere_else(time_limit: float) -> None:
    env = DrivingMultiAgentEnv({"time_limit": time_limit})
    seen = Counter()
    for seed in range(20):
        episode = recorded(env, seed)
        assert episode.is_done
        for agent in VEHICLES:
            single = episode.agent_episodes[agent]
            end = single.get_infos(-1)["end"]
            assert single.is_done
            assert single.is_terminated is (end != "time_limit")
            seen[agent, end == "time_limit"] += 1
    assert seen["vehicle_0", True] > 0
    assert time_limit < 5 or seen["vehicle_0", False] > 0


@pytest.mark.parametrize("options", [{}, {"scenario": "roundabout", "vehicles": 5}, {"harmful_g_force": 0.2}])
def test_every_vehicle_has_its_last_observation_and_reward_in_rllibs_episode(options: dict[str, Any]) -> None:
    config = {"time_limit": 3.0, **options}
    env, parallel = DrivingMultiAgentEnv(config), DrivingParallelEnv(**config)
    episode = recorded(env, 3)
    last: dict[str, Any] = {}
    rewards: Counter[str] = Counter()
    parallel.reset(seed=3)
    for actions, _ in play(DrivingMultiAgentEnv(config), 3):
        observations, vectors, *_ = parallel.step(actions)
        for agent, vector in vectors.items():
            last[agent] = observations[agent], float(env.utilities[agent](vector))
            rewards[agent] += 1
    assert set(last) == set(env.possible_agents)
    for agent, (observation, reward) in last.items():
        single = episode.agent_episodes[agent]
        np.testing.assert_array_equal(single.get_observations(-1), observation)
        assert single.get_rewards(-1) == reward
        assert len(single.get_observations()) == len(single.get_rewards()) + 1 == rewards[agent] + 1


def small(config: PPOConfig, runners: int = 0) -> PPOConfig:
    """PPO in the smallest possible configuration."""
    return (
        config.env_runners(num_env_runners=runners, num_envs_per_env_runner=2)
        .training(train_batch_size_per_learner=256, minibatch_size=64, num_epochs=1)
        .debugging(seed=0)
    )


def train(config: PPOConfig, policies: list[str]) -> dict[str, Any]:
    """One iteration, which must have sampled whole episodes and learnt from them; its metrics of sampling."""
    algorithm = config.build_algo()
    try:
        result = algorithm.train()
    finally:
        algorithm.stop()
    sampled: dict[str, Any] = result["env_runners"]
    assert sampled["num_env_steps_sampled"] >= 256
    assert sampled["num_episodes"] > 0
    assert math.isfinite(sampled["episode_return_mean"])
    assert set(sampled["num_module_steps_sampled"]) == set(policies)
    for policy in policies:
        assert sampled["num_module_steps_sampled"][policy] > 0
        assert all(math.isfinite(result["learners"][policy][loss]) for loss in ("total_loss", "policy_loss", "vf_loss"))
    return sampled


def one_policy_each(config: dict[str, Any], vehicles: list[str]) -> PPOConfig:
    """The settings in the documentation: every vehicle learns its own policy."""
    return (
        PPOConfig()
        .environment(DrivingMultiAgentEnv, env_config=config)
        .multi_agent(policies=set(vehicles), policy_mapping_fn=lambda agent, episode, **_: agent)
    )


@pytest.mark.usefixtures("cluster")
def test_ppo_trains_two_vehicles_with_separate_utilities_if_one_leaves_early() -> None:
    utilities = {"vehicle_0": "intersection_nonlinear", "vehicle_1": "intersection_linear"}
    config = {"utility": utilities, "harmful_g_force": 0.2, "time_limit": 9.0}
    sampled = train(small(one_policy_each(config, VEHICLES)), VEHICLES)
    assert sum(sampled["num_module_steps_sampled"].values()) < 2 * sampled["num_env_steps_sampled"]


@pytest.mark.usefixtures("cluster")
def test_ppo_trains_on_samples_of_another_process() -> None:
    config = {"action_type": "continuous", "time_limit": 5.0}
    train(small(one_policy_each(config, VEHICLES), runners=1), VEHICLES)


@pytest.mark.usefixtures("cluster")
def test_ppo_trains_on_a_gymnasium_id_that_mo_gymnasium_scalarises() -> None:
    def make(config: dict[str, Any]) -> LinearReward:
        env = mo_gymnasium.make("mo-deepdrive-one-waypoint-v0", **config)
        utility = make_utility("one_waypoint_linear", env.unwrapped.objectives)
        return LinearReward(env, weight=np.array(utility.weights))

    register_env("one_waypoint_linear", make)
    config = PPOConfig().environment("one_waypoint_linear", env_config={"time_limit": 5.0})
    train(small(config), ["default_policy"])
