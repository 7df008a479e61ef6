"""Best-known fronts: the stored policies earn the stored returns, and environments return their fronts."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import mo_deepdrive
from mo_deepdrive.fronts import reference_fronts
from mo_deepdrive.world.action_sequences import decode, discounted_sum, idle, replay
from mo_deepdrive.world.objectives import signs
from mo_deepdrive.world.scenarios import SCENARIOS

SHIPPED = sorted(
    (scenario, action_type)
    for scenario in SCENARIOS
    for action_type in ("discrete", "discrete-16", "continuous")
    if (reference_fronts.DATA / f"front_{scenario}_{action_type}.json").is_file()
)
GAMMAS = (0.99, 1.0)
TIME = "time"


def fixed(scenario: str) -> dict[str, Any]:
    """The arguments that make a scenario the same in every episode."""
    return {"fixed_destination": True, **({"fixed_obstacle": True} if scenario == "static_obstacle" else {})}


def dominates(first: np.ndarray, second: np.ndarray) -> bool:
    return bool((first >= second).all() and (first > second).any())


# --------------------------------------------------------------------------------------------------- shipped fronts


@pytest.mark.parametrize(("scenario", "action_type"), SHIPPED)
def test_every_policy_earns_the_returns_in_its_file(scenario: str, action_type: str) -> None:
    policies = reference_fronts.shipped(scenario, action_type)
    rewards = replay(
        reference_fronts.front_config(scenario, action_type), [decode(each.actions, action_type) for each in policies]
    )
    for gamma, stored in ((1.0, "undiscounted"), (reference_fronts.GAMMA, "discounted")):
        claimed = np.array([getattr(policy, stored) for policy in policies])
        np.testing.assert_allclose(discounted_sum(rewards, gamma), claimed, rtol=1e-5, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "action_type"), SHIPPED)
def test_every_policy_is_non_dominated_for_one_of_the_gammas(scenario: str, action_type: str) -> None:
    policies = reference_fronts.shipped(scenario, action_type)
    on_a_front = np.zeros(len(policies), dtype=bool)
    for gamma, stored in zip(GAMMAS, ("discounted", "undiscounted"), strict=True):
        front = mo_deepdrive.reference_front(scenario, action_type, gamma)
        assert not any(dominates(other, point) for point in front for other in front)
        claimed = np.array([getattr(policy, stored) for policy in policies])
        on_a_front |= np.isclose(claimed[:, None], front, rtol=1e-5, atol=2e-5).all(axis=2).any(axis=1)
    timed = mo_deepdrive.reference_front(scenario, action_type, 1.0, (*SCENARIOS[scenario].objectives, TIME))
    assert not any(dominates(other, point) for point in timed for other in timed)
    on_a_front |= np.isclose(claimed[:, None], timed[:, :-1], rtol=1e-5, atol=2e-5).all(axis=2).any(axis=1)
    assert on_a_front.all()


@pytest.mark.parametrize(("scenario", "action_type"), SHIPPED)
@pytest.mark.parametrize("gamma", GAMMAS)
def test_every_point_of_a_front_dominates_the_reference_point(scenario: str, action_type: str, gamma: float) -> None:
    reference = mo_deepdrive.reference_point(scenario, action_type, gamma).values
    front = mo_deepdrive.reference_front(scenario, action_type, gamma)
    assert all(dominates(point, reference) for point in front)
    arriving = front[front[:, 1] > 0.0]
    assert len(arriving) > 10
    assert (arriving > reference).all()


def test_a_policy_earns_its_return_in_the_public_environment(make_single: Any) -> None:
    for scenario, action_type in SHIPPED:
        env = make_single(scenario, action_type=action_type, **fixed(scenario))
        policies = reference_fronts.shipped(scenario, action_type)
        for policy in (policies[0], policies[len(policies) // 2], policies[-1]):
            actions = list(decode(policy.actions, action_type))
            env.reset(seed=3)
            returns, over = np.zeros(len(env.objectives)), False
            while not over:
                action = actions.pop(0) if actions else idle(action_type)
                _, reward, terminated, truncated, _ = env.step(action.astype(env.action_space.dtype))
                returns += reward
                over = terminated or truncated
            np.testing.assert_allclose(returns, policy.undiscounted, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("scenario", ["one_waypoint", "static_obstacle"])
def test_the_front_of_version_1_is_undiscounted_and_ending_early_saves_no_time(scenario: str) -> None:
    env: Any = gymnasium.make(f"mo-deepdrive-{scenario.replace('_', '-')}-v1", **fixed(scenario)).unwrapped
    front = np.array(env.pareto_front(1.0))
    np.testing.assert_array_equal(
        front, mo_deepdrive.reference_front(scenario, objectives=env.objectives, charge_remaining_time=True)
    )
    arriving = front[:, 1] > 0.0
    np.testing.assert_allclose(front[~arriving, -1], -60.0, rtol=1e-6)
    uncharged = mo_deepdrive.reference_front(scenario, objectives=env.objectives)
    assert {*map(tuple, uncharged[uncharged[:, 1] > 0.0])} <= {*map(tuple, front)}
    corner = mo_deepdrive.reference_point(scenario, objectives=env.objectives)
    assert corner.values[-1] == -60.0
    assert (front[arriving] > corner.values).all()


def test_a_front_of_fewer_objectives_is_non_dominated_in_them() -> None:
    names = ("jerk", "distance")
    full = mo_deepdrive.reference_front()
    front = mo_deepdrive.reference_front(objectives=names)
    columns = full[:, [3, 0]]
    kept = [not any(dominates(other, point) for other in columns) for point in columns]
    assert 1 < len(front) < len(full)
    assert {tuple(point) for point in front} == {tuple(point) for point in columns[kept]}


def test_a_front_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match=r"gamma = .* must lie in \[0, 1\]"):
        mo_deepdrive.reference_front(gamma=1.1)
    with pytest.raises(ValueError, match=r"no best-known front is shipped for scenario = 'intersection'.*discrete"):
        mo_deepdrive.reference_front("intersection")


# ---------------------------------------------------------------------------------------------------- environments


@pytest.mark.parametrize(("scenario", "action_type"), SHIPPED)
@pytest.mark.parametrize("gamma", GAMMAS)
def test_an_environment_returns_its_front(
    make_single: Any, make_vector: Any, scenario: str, action_type: str, gamma: float
) -> None:
    expected = mo_deepdrive.reference_front(scenario, action_type, gamma)
    for make in (make_single, make_vector):
        front = make(scenario, action_type=action_type, **fixed(scenario)).pareto_front(gamma)
        assert isinstance(front, list)
        np.testing.assert_array_equal(np.array(front), expected)


def test_an_environments_front_has_its_objectives_and_signs(make_single: Any) -> None:
    names = ["jerk", "destination"]
    env = make_single(**fixed("one_waypoint"), objectives=names)
    paper = make_single(**fixed("one_waypoint"), objectives=names, cost_sign="paper")
    expected = mo_deepdrive.reference_front(objectives=names)
    np.testing.assert_array_equal(np.array(env.pareto_front(0.99)), expected)
    np.testing.assert_array_equal(np.array(paper.pareto_front(0.99)), expected * signs(tuple(names)))
    assert (np.array(paper.pareto_front(0.99)) >= 0.0).all()
    assert not np.signbit(np.array(paper.pareto_front(0.99))).any()


@pytest.mark.parametrize(
    ("scenario", "options", "message"),
    [
        ("one_waypoint", {}, r"requires fixed_destination = True \(not False\)$"),
        ("static_obstacle", {"fixed_destination": True}, r"requires fixed_obstacle = True \(not False\)$"),
        ("static_obstacle", {}, "fixed_destination = True .*, fixed_obstacle = True"),
        ("one_waypoint", {"fixed_destination": True, "time_limit": 30.0}, r"time_limit = 60\.0 \(not 30\.0\)"),
        ("one_waypoint", {"fixed_destination": True, "harmful_g_force": None}, r"harmful_g_force = 1\.0 \(not None\)"),
    ],
)
def test_an_environment_without_a_front_says_what_one_would_require(
    make_single: Any, make_vector: Any, scenario: str, options: dict[str, Any], message: str
) -> None:
    for make in (make_single, make_vector):
        with pytest.raises(ValueError, match=message):
            make(scenario, **options).pareto_front(0.99)
