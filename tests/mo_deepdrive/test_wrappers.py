"""Vector rewards as scalars: utilities of rewards and returns, in our environments and in MO-Gymnasium's."""

from __future__ import annotations

from typing import Any

import gymnasium
import mo_gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv

import mo_deepdrive
from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.wrappers import (
    ParallelUtilityReward,
    ScaledObservation,
    UtilityReward,
    VectorEpisodeStatistics,
    VectorScaledObservation,
    VectorUtilityReward,
)

ONE_WAYPOINT = "mo-deepdrive-one-waypoint-v0"
INTERSECTION = "mo-deepdrive-intersection-v0"
LEFT_TURN = ("distance", "destination", "g_force", "collision", "jerk", "lane_violation", "time")
SCENARIOS: dict[str, Any] = {
    ONE_WAYPOINT: "one_waypoint_nonlinear",
    "mo-deepdrive-static-obstacle-v0": "static_obstacle_nonlinear",
    "mo-deepdrive-left-turn-v0": make_utility("linear", LEFT_TURN, weights=[0.1, 10.0, 0.1, 10.0, 0.0, 0.1, 0.1]),
    INTERSECTION: "intersection_nonlinear",
}


def play(env: Any, seed: int, decisions: int = 400) -> list[Any]:
    """The results of the reset and the steps of one episode of random actions."""
    played: list[Any] = [env.reset(seed=seed)]
    rng = np.random.default_rng(seed)
    for _ in range(decisions):
        played.append(env.step(int(rng.integers(env.action_space.n))))
        if played[-1][2] or played[-1][3]:
            break
    return played


@pytest.mark.parametrize("env_id", SCENARIOS)
@pytest.mark.parametrize("of", ["reward", "return"])
def test_everything_but_the_reward_is_that_of_the_wrapped_environment(env_id: str, of: Any) -> None:
    plain = play(mo_gymnasium.make(env_id), seed=3)
    wrapped = play(UtilityReward(mo_gymnasium.make(env_id), SCENARIOS[env_id], of), seed=3)
    assert len(plain) == len(wrapped)
    np.testing.assert_array_equal(plain[0][0], wrapped[0][0])
    assert plain[0][1] == wrapped[0][1]
    for before, after in zip(plain[1:], wrapped[1:], strict=True):
        np.testing.assert_array_equal(before[0], after[0])
        assert (before[2], before[3]) == (after[2], after[3])
        vector = after[4].pop("vector_reward")
        np.testing.assert_array_equal(before[1], vector)
        assert vector.dtype == np.float32
        assert before[4] == after[4]


@pytest.mark.parametrize("env_id", [ONE_WAYPOINT, INTERSECTION])
def test_rewards_of_the_accrued_reward_sum_to_the_utility_of_the_return(env_id: str) -> None:
    """Vehicles that take turns have separate returns."""
    env = UtilityReward(mo_gymnasium.make(env_id), SCENARIOS[env_id], of="return")
    for seed in (1, 2):  # the second episode starts from zero again
        played = play(env, seed)[1:]
        for vehicle in {step[4].get("vehicle") for step in played}:
            own = [step for step in played if step[4].get("vehicle") == vehicle]
            total = np.sum([step[4]["vector_reward"] for step in own], axis=0, dtype=np.float64)
            expected = float(env.utility(total) - env.utility(np.zeros(len(total))))
            assert sum(step[1] for step in own) == pytest.approx(expected)


def test_the_first_turn_of_a_vehicle_has_no_reward() -> None:
    env = UtilityReward(mo_gymnasium.make(INTERSECTION), "intersection_nonlinear")
    for seed in (0, 1):  # the second episode starts anew
        first, *later = play(env, seed)[1:]
        assert (first[4]["vehicle"], first[1]) == (1, 0.0)
        assert all(step[1] == float(env.utility(step[4]["vector_reward"])) for step in later)


@pytest.mark.filterwarnings("ignore")
def test_the_wrapped_environment_can_be_made_again_from_its_spec() -> None:
    env = UtilityReward(mo_gymnasium.make(ONE_WAYPOINT, fixed_destination=True), "one_waypoint_linear", of="return")
    again = gymnasium.make(env.spec)
    assert isinstance(again, UtilityReward)
    assert [step[1] for step in play(env, 5)[1:]] == [step[1] for step in play(again, 5)[1:]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"utility": "one_waypoint_linaer"}, "did you mean 'one_waypoint_linear'"),
        ({"utility": "static_obstacle_linear"}, "needs collision; the environment has"),
        ({"utility": "one_waypoint_linear", "of": "episode"}, "of = 'episode' must be one of"),
        ({"utility": make_utility("linear", ["a", "b"], weights=[1.0, 1.0])}, "takes"),
        ({"utility": make_utility("linear", list("abcd"), weights=[1.0] * 4), "weights": [1.0] * 4}, "by name"),
        (
            {"utility": make_utility("linear", ["destination", "distance", "g_force", "jerk"], weights=[1.0] * 4)},
            r"takes \('destination', 'distance', .*; the environment has \('distance', 'destination'",
        ),
    ],
)
def test_unsuitable_utilities_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        UtilityReward(mo_gymnasium.make(ONE_WAYPOINT), **arguments)


class NamedObjectives(gymnasium.Wrapper[Any, Any, Any, Any]):
    objectives = ("treasure", "time")


def test_a_wrapper_may_name_the_objectives() -> None:
    env = NamedObjectives(mo_gymnasium.make("deep-sea-treasure-v0"))
    assert UtilityReward(env, "linear", weights={"time": 1.0}).utility.objectives == ("treasure", "time")
    with pytest.raises(ValueError, match=r"the environment has \('treasure', 'time'\)"):
        UtilityReward(env, make_utility("linear", ["time", "treasure"], weights=[1.0, 0.0]))


# ----------------------------------------------------------------------------------------------------------- parallel


def drive(env: Any, seed: int) -> list[Any]:
    """The results of the steps of one episode of random actions."""
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    steps = []
    while env.agents:
        # Drawn for all, so that those of one agent do not depend on who is left.
        actions = dict(zip(env.possible_agents, rng.integers(22, size=len(env.possible_agents)).tolist(), strict=True))
        steps.append(env.step({agent: actions[agent] for agent in env.agents}))
    return steps


def test_everything_but_the_rewards_is_that_of_the_wrapped_parallel_environment() -> None:
    utility = make_utility("intersection_nonlinear", mo_deepdrive.parallel_env().objectives)
    plain = drive(mo_deepdrive.parallel_env(), seed=3)
    wrapped = drive(ParallelUtilityReward(mo_deepdrive.parallel_env(), "intersection_nonlinear"), seed=3)
    assert len(plain) == len(wrapped)
    for before, after in zip(plain, wrapped, strict=True):
        assert before[1].keys() == after[1].keys() == after[4].keys()
        assert (before[2], before[3]) == (after[2], after[3])
        for agent, reward in after[1].items():
            vector = after[4][agent].pop("vector_reward")
            np.testing.assert_array_equal(before[1][agent], vector)
            np.testing.assert_array_equal(before[0][agent], after[0][agent])
            assert type(reward) is float
            assert reward == float(utility(vector))
            assert before[4][agent] == after[4][agent]


@pytest.mark.parametrize("of", ["reward", "return"])
def test_a_vehicle_that_stays_after_its_end_has_no_rewards(of: Any) -> None:
    utility = "intersection_nonlinear"
    kept = ParallelUtilityReward(mo_deepdrive.parallel_env(keep_finished=True), utility, of)
    leaving = ParallelUtilityReward(mo_deepdrive.parallel_env(), utility, of)
    stayed = 0
    for seed in (3, 4):  # in the second episode it has rewards again
        for ours, theirs in zip(drive(kept, seed), drive(leaving, seed), strict=True):
            absent = ours[1].keys() - theirs[1].keys()
            assert ours[1] == {**theirs[1], **dict.fromkeys(absent, 0.0)}
            stayed += len(absent)
    assert stayed > 0


def test_agents_may_have_different_utilities_and_weights() -> None:
    env = mo_deepdrive.parallel_env()
    weights = make_utility("linear", env.objectives, weights=[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    wrapped = ParallelUtilityReward(env, {"vehicle_0": weights, "vehicle_1": "intersection_linear"}, of="return")
    linear = wrapped.utilities["vehicle_1"]
    for seed in (1, 2):  # the second episode starts from zero again
        steps = drive(wrapped, seed)
        for agent, utility in (("vehicle_0", weights), ("vehicle_1", linear)):
            own = [step for step in steps if agent in step[1]]
            total = np.sum([step[4][agent]["vector_reward"] for step in own], axis=0, dtype=np.float64)
            assert sum(step[1][agent] for step in own) == pytest.approx(float(utility(total)), rel=1e-5)


@pytest.mark.parametrize(
    ("utility", "message"),
    [
        ("intersection_linaer", "did you mean 'intersection_linear'"),
        ({"vehicle_0": "intersection_linear"}, "utility is missing for 'vehicle_1'"),
        ({"vehicle_2": "intersection_linear"}, "'vehicle_2', which is unknown; did you mean 'vehicle_"),
        (make_utility("linear", list("abcdef"), weights=[1.0] * 6), "takes"),
    ],
)
def test_unsuitable_utilities_of_agents_are_refused(utility: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ParallelUtilityReward(mo_deepdrive.parallel_env(), utility)


# ------------------------------------------------------------------------------------------------------------- vector


def actions_of(count: int, seed: int = 5) -> Any:
    return np.random.default_rng(seed).integers(22, size=(1000, count))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("of", ["reward", "return"])
@pytest.mark.parametrize("env_id", [ONE_WAYPOINT, "mo-deepdrive-left-turn-v0"])
def test_a_row_of_a_vector_environment_has_the_rewards_of_a_single_environment(env_id: str, of: Any, mode: str) -> None:
    name = {ONE_WAYPOINT: "one_waypoint_nonlinear"}.get(env_id, "left_turn_risk_averse")
    many = VectorUtilityReward(gymnasium.make_vec(env_id, num_envs=3, autoreset_mode=mode, time_limit=5.0), name, of)
    many.reset(seed=7)
    rows, vectors, episodes = [], [], np.zeros(3, dtype=int)
    chosen = actions_of(3)[:150]
    over = np.zeros(3, dtype=np.bool_)
    expected: list[list[float]] = [[], [], []]
    singles = [UtilityReward(mo_gymnasium.make(env_id, time_limit=5.0), name, of) for _ in range(3)]
    for i, single in enumerate(singles):
        single.reset(seed=7 + i)
    for joint in chosen:
        _, rewards, terminated, truncated, infos = many.step(joint)
        rows.append(rewards)
        vectors.append(infos["vector_reward"])
        for i, single in enumerate(singles):
            if over[i]:
                single.reset()
            if over[i] and mode == "NextStep":
                expected[i].append(0.0)
                over[i] = False
                continue
            _, reward, ended, stopped, _ = single.step(joint[i])
            expected[i].append(float(reward))
            over[i] = ended or stopped
        np.testing.assert_array_equal(over, terminated | truncated)
        episodes += over
    assert episodes.min() > 0
    assert np.array(rows).T.tolist() == expected
    assert many.reward_space.shape == ()
    assert np.array(vectors).shape == (150, 3, many.unwrapped.reward_dim)


@pytest.mark.parametrize("of", ["reward", "return"])
def test_vehicles_of_a_vector_environment_have_the_rewards_of_agents(of: Any) -> None:
    many = VectorUtilityReward(
        gymnasium.make_vec(INTERSECTION, num_envs=2, autoreset_mode="SameStep", time_limit=8.0),
        "intersection_nonlinear",
        of,
    )
    agents = ParallelUtilityReward(mo_deepdrive.parallel_env(time_limit=8.0), "intersection_nonlinear", of)
    many.reset(seed=3)
    agents.reset(seed=3)
    assert many.reward_space.shape == (2,)
    episodes = 0
    for joint in actions_of(4)[:300].reshape(-1, 2, 2):
        rewards = many.step(joint)[1]
        actions = dict(zip(agents.possible_agents, joint[0].tolist(), strict=True))
        expected = agents.step({agent: actions[agent] for agent in agents.agents})[1]
        assert rewards[0].tolist() == [expected.get(agent, 0.0) for agent in agents.possible_agents]
        if not agents.agents:
            agents.reset()
            episodes += 1
    assert episodes > 1


def test_environments_that_are_reset_alone_start_their_return_alone() -> None:
    envs = VectorUtilityReward(
        gymnasium.make_vec(ONE_WAYPOINT, num_envs=2, autoreset_mode="Disabled"), "one_waypoint_nonlinear", of="return"
    )
    envs.reset(seed=[1, 1], options={"destination": (25.0, 30.0)})
    first = [envs.step(np.array([3, 3]))[1][0] for _ in range(5)]
    envs.reset(seed=[1, None], options={"reset_mask": np.array([True, False]), "destination": (25.0, 30.0)})
    again = np.array([envs.step(np.array([3, 3]))[1] for _ in range(5)])
    assert again[:, 0].tolist() == first
    assert again[:, 1].tolist() != first


def test_vector_environments_of_other_libraries_can_be_wrapped() -> None:
    def make() -> Any:
        return mo_gymnasium.make("deep-sea-treasure-v0")

    envs = VectorUtilityReward(MOSyncVectorEnv([make, make]), "linear", of="return", weights=np.array([1.0, 0.5]))
    single = UtilityReward(make(), "linear", of="return", weights=[1.0, 0.5])
    envs.reset(seed=0)
    single.reset(seed=0)
    over = False
    for action in (3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 3, 1, 1, 1):
        rewards = envs.step(np.array([action, 0]))[1]
        if over:
            single.reset()
            assert rewards[0] == 0.0
            over = False
        else:
            _, reward, over, *_ = single.step(action)
            assert rewards[0] == reward


def test_a_vector_environment_without_vector_rewards_is_refused() -> None:
    envs = gymnasium.make_vec(ONE_WAYPOINT, num_envs=2)
    with pytest.raises(ValueError, match="VectorUtilityReward wraps it"):
        UtilityReward(envs, "one_waypoint_linear")  # type: ignore[arg-type]
    scalar = VectorUtilityReward(envs, "one_waypoint_linear")
    for env in (gymnasium.make_vec("CartPole-v1", num_envs=2), scalar):
        with pytest.raises(ValueError, match="no reward_space"):
            VectorUtilityReward(env, "one_waypoint_linear")
    with pytest.raises(ValueError, match="no reward_space"):
        UtilityReward(gymnasium.make("CartPole-v1"), "linear", weights=[1.0])
    turns = MOSyncVectorEnv([lambda: mo_gymnasium.make(INTERSECTION)])
    with pytest.raises(ValueError, match=r"take turns .*make_vec"):
        VectorUtilityReward(turns, "intersection_linear").reset()


# --------------------------------------------------------------------------------------------------------- statistics


def native(mode: str, env_id: str = ONE_WAYPOINT) -> Any:
    return gymnasium.make_vec(env_id, num_envs=3, autoreset_mode=mode, time_limit=5.0)


def of_mo_gymnasium() -> Any:
    return MOSyncVectorEnv([lambda: mo_gymnasium.make(ONE_WAYPOINT, time_limit=5.0)] * 3)


STATISTICS = {
    "NextStep": lambda: native("NextStep"),
    "SameStep": lambda: native("SameStep"),
    "Disabled": lambda: native("Disabled"),
    "two vehicles, NextStep": lambda: native("NextStep", INTERSECTION),
    "two vehicles, SameStep": lambda: native("SameStep", INTERSECTION),
    "two vehicles, Disabled": lambda: native("Disabled", INTERSECTION),
    "MO-Gymnasium's": of_mo_gymnasium,
}


@pytest.mark.parametrize("kind", STATISTICS)
def test_the_statistics_of_every_episode_are_those_of_its_rewards(kind: str) -> None:
    gamma = 0.9
    env, plain = VectorEpisodeStatistics(STATISTICS[kind](), gamma), STATISTICS[kind]()
    mode = plain.metadata["autoreset_mode"]
    env.reset(seed=7)
    plain.reset(seed=7)
    rewards: list[list[Any]] = [[], [], []]
    resets = np.zeros(3, dtype=np.bool_)
    episodes = np.zeros(3, dtype=int)
    for joint in actions_of(6).reshape(-1, 3, 2)[:300]:
        actions = joint if plain.action_space.shape == (3, 2) else joint[:, 0]
        *step, infos = env.step(actions)
        for mine, theirs in zip(step, plain.step(actions), strict=False):
            np.testing.assert_array_equal(mine, theirs)
        over = (step[2] | step[3]).reshape(3, -1).all(axis=1)
        np.testing.assert_array_equal(infos.get("_episode", np.zeros(3, dtype=np.bool_)), over)
        for row in np.flatnonzero(~resets):
            rewards[row].append(step[1][row].astype(np.float64))
        for row in np.flatnonzero(over):
            found, expected = infos["episode"], np.array(rewards[row])
            assert found["l"][row] == len(expected)
            np.testing.assert_allclose(found["r"][row], expected.sum(axis=0))
            discounts = gamma ** np.arange(len(expected))
            np.testing.assert_allclose(found["dr"][row], np.tensordot(discounts, expected, axes=1))
            rewards[row] = []
        episodes += over
        resets = over & (mode is AutoresetMode.NEXT_STEP)
        if mode is AutoresetMode.DISABLED and over.any():
            for each in (env, plain):
                each.reset(options={"reset_mask": over})
    assert episodes.min() >= 3


def test_the_statistics_of_an_episode_that_is_broken_off_do_not_count() -> None:
    env = VectorEpisodeStatistics(native("SameStep"))
    env.reset(seed=1)
    for _ in range(30):
        env.step(np.array([0, 0, 0]))
    env.reset(seed=1)
    lengths = [env.step(np.array([0, 0, 0]))[4].get("episode", {}).get("l") for _ in range(50)]
    assert lengths[-1].tolist() == [50, 50, 50]
    with pytest.raises(ValueError, match=r"gamma = 1\.1 must be between 0 and 1"):
        VectorEpisodeStatistics(native("SameStep"), gamma=1.1)


# ------------------------------------------------------------------------------------------------------- observations


@pytest.mark.parametrize("env_id", SCENARIOS)
def test_observations_are_divided_by_the_scales_that_learners_use(env_id: str) -> None:
    single = ScaledObservation(mo_gymnasium.make(env_id))
    many = VectorScaledObservation(gymnasium.make_vec(env_id, num_envs=2, autoreset_mode="SameStep"))
    scales = EnvAdapter(many.unwrapped).observation_scales
    parallel = mo_deepdrive.parallel_env(scenario=many.unwrapped.config.scenario)
    for env in (single.unwrapped, many.unwrapped, parallel.unwrapped):
        np.testing.assert_array_equal(env.observation_scales, scales)
    plain = gymnasium.make_vec(env_id, num_envs=2, autoreset_mode="SameStep")
    first, _ = plain.reset(seed=2)
    assert many.reset(seed=2)[0].tolist() == (first / scales).tolist()
    assert single.reset(seed=2)[0].tolist() == (first / scales).reshape(-1, len(scales))[0].tolist()
    ended = False
    for actions in actions_of(plain.action_space.shape[0] * parallel.max_num_agents)[:400]:
        joint = actions.reshape(plain.action_space.shape)
        ours, theirs = many.step(joint), plain.step(joint)
        assert ours[0] in many.observation_space
        assert ours[0].tolist() == (theirs[0] / scales).tolist()
        if "final_obs" in theirs[4]:
            ended = True
            assert ours[4]["final_obs"].tolist() == (theirs[4]["final_obs"] / scales).tolist()
    assert ended


def test_scales_of_other_environments_are_given() -> None:
    env = gymnasium.make("CartPole-v1")
    with pytest.raises(ValueError, match=r"has no observation_scales; give scales in the shape .*\(4,\)"):
        ScaledObservation(env)
    with pytest.raises(ValueError, match=r"scales = \[1, 0, 1, 1\] must be positive"):
        ScaledObservation(env, scales=[1, 0, 1, 1])
    many = gymnasium.make_vec("CartPole-v1", 2, "sync", vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP})
    envs = VectorScaledObservation(many, scales=[2.0] * 4)
    envs.reset(seed=0)
    final: Any = {}
    while "final_obs" not in final:
        *_, final = envs.step(np.ones(2, dtype=int))
    last = next(each for each in final["final_obs"] if each is not None)
    assert last.dtype == np.float32
    assert abs(last[2]) * 2.0 > 0.2  # rad; beyond it the episode ends
