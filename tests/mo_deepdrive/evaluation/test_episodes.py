"""Evaluations against episodes replayed one by one, and their metrics against numbers calculated by hand."""

from __future__ import annotations

from typing import Any

import gymnasium
import mo_gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

from algorithms import A2C, MOA2C
from algorithms.actor_critic import ActorCritic
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.evaluation import Evaluation
from mo_deepdrive.utilities import Utility, make_utility
from tests.helpers.agents import diversified

ONE_WAYPOINT = "mo-deepdrive-one-waypoint-v0"
STATIC_OBSTACLE = "mo-deepdrive-static-obstacle-v0"
INTERSECTION = "mo-deepdrive-intersection-v0"
SEA = "deep-sea-treasure-v0"
OBJECTIVES = ("distance", "destination", "g_force", "jerk")
NONLINEAR = make_utility("one_waypoint_nonlinear", OBJECTIVES)
CLASSES = pytest.mark.parametrize("cls", [A2C, MOA2C])


def make_agent(
    cls: type[ActorCritic], env_id: str = ONE_WAYPOINT, utility: Utility | None = None, **settings: Any
) -> ActorCritic:
    env = make_env(env_id, settings.pop("num_envs", 4), settings.pop("env", None))
    objectives = EnvAdapter(env).objectives
    if utility is None:
        utility = make_utility("linear", objectives, weights=np.linspace(1.0, 0.1, len(objectives)))
    return cls(env, utility, **settings)


def fields(evaluation: Evaluation) -> dict[str, np.ndarray]:
    return {name: value for name, value in vars(evaluation).items() if isinstance(value, np.ndarray)}


def assert_same(first: Evaluation, second: Evaluation) -> None:
    for name, array in fields(first).items():
        np.testing.assert_array_equal(array, getattr(second, name), err_msg=name)


def differ(first: Evaluation, second: Evaluation) -> bool:
    return not np.array_equal(first.returns, second.returns)


# Separation from learning.


@pytest.mark.slow
@CLASSES
@pytest.mark.parametrize("env_id", [ONE_WAYPOINT, INTERSECTION, SEA])
def test_training_with_and_without_evaluations_gives_the_same_weights(cls: type[ActorCritic], env_id: str) -> None:
    plain, watched = make_agent(cls, env_id, steps=8), make_agent(cls, env_id, steps=8)
    plain.train(256)
    arguments = {"max_episode_steps": 10}
    logged = []
    watched.train(
        256,
        make_env(env_id, 3, arguments),
        eval_interval=64,
        eval_episodes=5,
        log=lambda step, metrics: logged.append(metrics),
    )
    assert sum(any(name.startswith("eval/stochastic/") for name in metrics) for metrics in logged) == 5
    for one, other in zip(plain.learners, watched.learners, strict=True):
        expected, found = one.get_state(), other.get_state()
        assert expected.keys() == found.keys()
        assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert torch.equal(plain.generator.get_state(), watched.generator.get_state())
    found = watched.collector.get_state(0)
    for name, array in plain.collector.get_state(0).items():
        np.testing.assert_array_equal(array, found[name])


@CLASSES
@pytest.mark.parametrize("env_id", [ONE_WAYPOINT, INTERSECTION, SEA])
@pytest.mark.parametrize("greedy", [True, False])
def test_the_same_seed_gives_the_same_result(cls: type[ActorCritic], env_id: str, greedy: bool) -> None:
    agent = diversified(make_agent(cls, env_id))
    env, twin = (make_env(env_id, 3, {"max_episode_steps": 30}) for _ in range(2))
    first = evaluate(agent, env, episodes=5, seed=7, greedy=greedy)
    assert_same(first, evaluate(agent, env, episodes=5, seed=7, greedy=greedy))
    assert_same(first, evaluate(agent, twin, episodes=5, seed=7, greedy=greedy))
    if env_id != SEA:
        assert differ(first, evaluate(agent, env, episodes=5, seed=8, greedy=greedy))


@pytest.mark.parametrize("env_id", [ONE_WAYPOINT, SEA])
def test_the_greedy_and_the_stochastic_policy_of_an_agent_differ(env_id: str) -> None:
    agent = make_agent(A2C, env_id)
    env = make_env(env_id, 6, {"max_episode_steps": 30})
    greedy = evaluate(agent, env, episodes=6, seed=7, greedy=True)
    stochastic = evaluate(agent, env, episodes=6, seed=7, greedy=False)
    assert differ(greedy, stochastic)
    if env_id == SEA:  # where every episode begins alike and nothing else is random
        assert (greedy.returns == greedy.returns[0]).all()
        assert not (stochastic.returns == stochastic.returns[0]).all()


# Episodes.

SHORT = {"time_limit": 2.5}
SITUATIONS = {  # in which episodes end in more than one way
    "one_waypoint": (ONE_WAYPOINT, {"time_limit": 11.0}),
    "one_waypoint, continuous": (ONE_WAYPOINT, {"action_type": "continuous", "time_limit": 3.0}),
    "static_obstacle": (STATIC_OBSTACLE, {"time_limit": 5.0}),
}


def replay(agent: ActorCritic, env: Any, seed: int, gamma: float) -> dict[str, Any]:
    """One greedy episode in a single environment, with everything added up step by step."""
    observation, _ = env.reset(seed=seed)
    d = len(agent.env.objectives)
    accrued, returns, discounted, largest = (np.zeros(d) for _ in range(4))
    t, over, info = 0, False, {}
    while not over:
        action = agent.eval(observation, accrued, agent.config.gamma**t)
        observation, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        accrued = accrued + agent.config.gamma**t * reward
        returns = returns + reward
        discounted = discounted + gamma**t * reward
        largest = np.maximum(largest, np.abs(reward))
        t += 1
    return {
        "returns": returns,
        "discounted": discounted,
        "largest": largest,
        "lengths": t,
        "succeeded": info.get("success", False),
        "ends": info.get("end"),
    }


def assert_replayed(found: Evaluation, agent: ActorCritic, single: Any, seed: int, gamma: float) -> None:
    for i in range(len(found.returns)):
        expected = replay(agent, single, seed + i, gamma)
        for name in ("returns", "discounted", "largest"):
            np.testing.assert_allclose(getattr(found, name)[i, 0], expected[name], rtol=1e-4, atol=1e-4, err_msg=name)
        assert found.lengths[i, 0] == expected["lengths"]
        assert found.succeeded[i, 0] == expected["succeeded"]
        assert found.ends[i, 0] == expected["ends"]


@pytest.mark.slow
@CLASSES
@pytest.mark.parametrize("place", SITUATIONS)
@pytest.mark.parametrize("num_envs", [1, 4])
def test_episode_i_is_the_first_one_of_a_single_environment_with_that_seed(
    cls: type[ActorCritic], place: str, num_envs: int
) -> None:
    env_id, arguments = SITUATIONS[place]
    agent = diversified(make_agent(cls, env_id, env=arguments, gamma=0.97))
    found = evaluate(agent, make_env(env_id, num_envs, arguments), episodes=6, seed=40, gamma=0.9)
    single = gymnasium.make(env_id, disable_env_checker=True, **arguments).unwrapped
    assert found.returns.shape == (6, 1, len(agent.env.objectives))
    assert_replayed(found, agent, single, 40, 0.9)


@CLASSES
def test_episodes_of_other_environments_are_replayed_without_their_resets(cls: type[ActorCritic]) -> None:
    agent = diversified(make_agent(cls, SEA))
    found = evaluate(agent, make_env(SEA, 3, {"max_episode_steps": 9}), episodes=7, seed=40, gamma=0.5)
    assert_replayed(found, agent, mo_gymnasium.make(SEA, max_episode_steps=9), 40, 0.5)
    assert found.end_rates() == {}


@CLASSES
def test_only_the_first_episode_of_every_environment_counts(cls: type[ActorCritic]) -> None:
    """In deep-sea-treasure stochastic episodes last between 1 and 40 steps: short ones are over many times."""
    agent = make_agent(cls, SEA)
    found = evaluate(agent, make_env(SEA, 8, {"max_episode_steps": 40}), episodes=20, greedy=False)
    assert found.lengths.min() < 5 < 20 < found.lengths.max()
    # Time costs 1 per step, and a treasure is found at most once.
    np.testing.assert_array_equal(found.returns[..., 1], -found.lengths)
    treasures = {0.0, 0.7, 8.2, 11.5, 14.0, 15.1, 16.1, 19.6, 20.3, 22.4, 23.7}
    assert {round(float(treasure), 3) for treasure in found.returns[:, 0, 0]} <= treasures


@pytest.mark.parametrize("together", [False, True])
def test_vehicles_are_counted_separately_until_each_has_ended(together: bool) -> None:
    arguments = {"end_together": together, "time_limit": 20.0}
    agent = diversified(make_agent(A2C, INTERSECTION, env=arguments))
    found = evaluate(agent, make_env(INTERSECTION, 3, arguments), episodes=5, seed=11, gamma=0.9)
    assert found.returns.shape == (5, 2, 6)
    assert (found.lengths[:, 0] == found.lengths[:, 1]).all() == together
    for i in range(5):
        env = gymnasium.make_vec(INTERSECTION, num_envs=1, autoreset_mode=AutoresetMode.DISABLED, **arguments)
        observation, _ = env.reset(seed=11 + i)
        accrued, returns, discounted, largest = (np.zeros((2, 6)) for _ in range(4))
        lengths, over, t, infos = np.zeros(2, dtype=int), np.zeros(2, dtype=bool), 0, {}
        while not over.all():
            action = agent.eval(observation[0], accrued, agent.config.gamma**t)
            observation, reward, terminated, truncated, infos = env.step(action[None])
            counted = np.where(over[:, None], 0.0, reward[0])
            accrued, returns = accrued + agent.config.gamma**t * counted, returns + counted
            discounted, largest = discounted + 0.9**t * counted, np.maximum(largest, np.abs(counted))
            lengths, over, t = lengths + ~over, (terminated | truncated)[0], t + 1
        np.testing.assert_allclose(found.returns[i], returns, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(found.discounted[i], discounted, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(found.largest[i], largest, rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(found.lengths[i], lengths)
        np.testing.assert_array_equal(found.ends[i], infos["end"][0])
        np.testing.assert_array_equal(found.succeeded[i], infos["success"][0])


# Metrics.


def made(returns: list[list[float]], utility: Utility, **others: Any) -> Evaluation:
    array = np.array(returns)[:, None]
    e = len(array)
    defaults: dict[str, Any] = {
        "discounted": array / 2,
        "lengths": np.full((e, 1), 10),
        "succeeded": np.zeros((e, 1), dtype=np.bool_),
        "ends": np.full((e, 1), "backwards", dtype=object),
        "largest": np.abs(array),
    }
    return Evaluation(utility.objectives, (utility,), array, **{**defaults, **others})


# Distance, destination, minus g-force, minus jerk.
TWO_RETURNS = [[6.0, 1.0, -2.0, -4.0], [-2.0, 0.0, -10.0, -20.0]]


def test_esr_is_the_mean_utility_and_ser_the_utility_of_the_mean() -> None:
    metrics = made(TWO_RETURNS, NONLINEAR).metrics()
    # u = 0.5 6 + 6 1 - 0.1 2 - 0.1 4 = 8.4 and 0.5 (-2) + 0 - 1^2 - 2^2 = -6; the mean return is (2, 0.5, -6, -12).
    assert metrics["utility_esr"] == pytest.approx((8.4 - 6.0) / 2)
    assert metrics["utility_ser"] == pytest.approx(0.5 * 2 + 0.5 - 0.6**2 - 1.2**2)
    # Halved: (3, 0.5, -1, -2), (-1, 0, -5, -10), and their mean (1, 0.25, -3, -6).
    first, second = 0.5 * 3 + 3 * 0.5 - 0.1 - 0.2, -0.5 - 0.5**2 - 1.0**2
    assert metrics["discounted_utility_esr"] == pytest.approx((first + second) / 2)
    assert metrics["discounted_utility_ser"] == pytest.approx(0.5 + 0.25 - 0.3**2 - 0.6**2)


def test_rates_of_comfort_are_means_per_decision_and_largest_magnitudes() -> None:
    returns = [[3.0, 0.0, -8.0, 0.0], [5.0, 0.0, -2.0, 0.0]]
    metrics = made(returns, NONLINEAR, lengths=np.array([[4], [0]])).metrics()
    assert metrics["mean_g_force"] == pytest.approx((8.0 / 4 + 2.0) / 2)
    assert metrics["max_g_force"] == 8.0
    assert "mean_distance" not in metrics


def test_every_vehicle_has_its_own_metrics_and_utility() -> None:
    env = make_env(INTERSECTION, 2, SHORT)
    objectives = EnvAdapter(env).objectives
    utilities = [make_utility("intersection_linear", objectives), make_utility("intersection_nonlinear", objectives)]
    found = evaluate(A2C(env, utilities), make_env(INTERSECTION, 4, SHORT), episodes=4, greedy=False)
    metrics = found.metrics()
    of_both = {name for name in metrics if not name.startswith(("vehicle_0/", "vehicle_1/"))}
    utilities_of_both = {"total_utility_esr", "mean_utility_esr", "worst_off_utility_esr", "gini_utility_esr"}
    assert of_both == {"success", "end/collision", "share_arrived", "share_collided"} | utilities_of_both
    assert metrics["share_arrived"] == np.mean([metrics[f"vehicle_{v}/success"] for v in (0, 1)])
    assert {name: metrics[name] for name in of_both} == pytest.approx(
        {name: each.value for name, each in found.estimates().items() if name in of_both}
    )
    assert metrics["total_utility_esr"] == pytest.approx(sum(metrics[f"vehicle_{v}/utility_esr"] for v in (0, 1)))
    for v, utility in enumerate(utilities):
        values = [float(utility(found.returns[i, v])) for i in range(4)]
        assert metrics[f"vehicle_{v}/utility_esr"] == pytest.approx(np.mean(values))
        np.testing.assert_allclose(found.episode_utilities(v), values)
        assert metrics[f"vehicle_{v}/utility_ser"] == pytest.approx(float(utility(found.returns[:, v].mean(axis=0))))
        assert metrics[f"vehicle_{v}/return/lane_violation"] == pytest.approx(found.returns[:, v, 5].mean())


def test_the_success_of_all_vehicles_is_that_they_arrive_in_the_same_episode() -> None:
    agent = make_agent(A2C, INTERSECTION)
    found = evaluate(agent, make_env(INTERSECTION, 4, SHORT), episodes=4)
    found.succeeded[:] = [[True, True], [True, False], [False, True], [False, False]]
    metrics = found.metrics()
    assert metrics["success"] == 0.25
    assert metrics["vehicle_0/success"] == metrics["vehicle_1/success"] == 0.5


# Arguments.


def idle(observations: Any, *_: Any) -> Any:
    return np.zeros(observations.shape[:-1], dtype=np.int64)


def test_an_id_with_a_split_is_the_environment_with_the_seeds_of_the_split() -> None:
    agent = diversified(make_agent(A2C))
    env = make_env(ONE_WAYPOINT, 5, SHORT)
    for split, seed in (("validation", 2_000_000), ("test", 3_000_000)):
        found = evaluate(agent, ONE_WAYPOINT, split=split, episodes=5, env_kwargs=SHORT)
        assert_same(found, evaluate(agent, env, seed=seed, episodes=5))
        assert found.utilities == tuple(agent.utilities)
    assert_same(evaluate(agent, env, episodes=5), evaluate(agent, env, split="validation", episodes=5))
    named = evaluate(agent, f"mo_deepdrive:{ONE_WAYPOINT}", split="test", episodes=5, env_kwargs=SHORT)
    assert_same(named, found)


@pytest.mark.parametrize(
    "utility",
    ["one_waypoint_nonlinear", NONLINEAR, lambda returns: NONLINEAR(returns), [NONLINEAR]],
    ids=["name", "utility", "function", "list"],
)
def test_a_utility_is_given_by_name_as_a_utility_or_as_a_function(utility: Any) -> None:
    found = evaluate(idle, ONE_WAYPOINT, episodes=3, env_kwargs=SHORT, utility=utility)
    np.testing.assert_allclose(found.episode_utilities(), NONLINEAR(found.returns[:, 0]))
    assert found.metrics()["utility_esr"] == found.estimates()["utility_esr"].value


@pytest.mark.parametrize(
    ("env_id", "env_kwargs", "what"),
    [
        (ONE_WAYPOINT, {"objectives": ["jerk", "distance", "destination", "g_force"]}, "objectives"),
        (ONE_WAYPOINT, {"action_type": "continuous"}, "actions"),
        (ONE_WAYPOINT, {"cost_sign": "paper"}, "cost_sign"),
        (STATIC_OBSTACLE, {}, "name"),
    ],
)
def test_an_agent_of_another_task_is_refused(env_id: str, env_kwargs: dict[str, Any], what: str) -> None:
    with pytest.raises(ValueError, match=f"a policy for {what} = .* cannot drive where {what} = "):
        evaluate(make_agent(A2C), env_id, episodes=2, env_kwargs=env_kwargs)


def test_without_a_utility_the_estimates_are_those_of_returns_and_rates() -> None:
    found = evaluate(idle, ONE_WAYPOINT, episodes=3, env_kwargs=SHORT)
    estimates = found.estimates()
    assert not any("utility" in name for name in [*estimates, *found.metrics()])
    assert estimates["return/jerk"].value == pytest.approx(found.metrics()["return/jerk"])
    assert estimates["success"].low == 0.0
    assert estimates["success"].high == pytest.approx(0.56, abs=0.01)  # Wilson's, of 0 in 3


@pytest.mark.parametrize(
    ("policy", "options", "error", "message"),
    [
        (idle, {"split": "train"}, ValueError, r"split = 'train' must be one of \['validation', 'test'\]"),
        (idle, {"split": "test", "seed": 3}, ValueError, "split = 'test' and seed = 3 are both given"),
        (idle, {"split": "test", "episodes": 2001}, ValueError, "episodes = 2001 exceeds the 2,000 scenarios"),
        (idle, {"episodes": 0}, ValueError, "episodes = 0 must be a positive integer"),
        (idle, {"gamma": 1.5}, ValueError, "gamma = 1.5 must be between 0 and 1"),
        (idle, {"greedy": False}, ValueError, "greedy = False is for agents"),
        (idle, {"utility": "one_waypoint_linaer"}, ValueError, "did you mean 'one_waypoint_linear'"),
        (idle, {"utility": [NONLINEAR] * 2}, ValueError, "2 utilities are given for 1 vehicles"),
        (idle, {"utility": lambda returns: returns}, ValueError, "utility '<lambda>' gives"),
        (idle, {"utility": make_utility("linear", ["a"], weights=[1.0])}, ValueError, "the environment has"),
        (idle, {"utility": make_utility("linear", OBJECTIVES[::-1], weights=[1.0] * 4)}, ValueError, "in this order"),
        (idle, {"env_kwargs": {"time_limt": 3.0}}, TypeError, "did you mean 'time_limit'"),
        ("ppo", {}, TypeError, "policy = 'ppo' must be an agent or a function"),
        (lambda a, b, c, d: 0, {}, TypeError, r"<lambda>\(a, b, c, d\) cannot be called as policy\(observations, accr"),
    ],
)
def test_invalid_arguments_are_refused(policy: Any, options: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        evaluate(policy, ONE_WAYPOINT, **options)
