"""Reference points and best-known fronts: shipped drives are what they claim to be, and environments know theirs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mo_gymnasium
import moocore
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mo_deepdrive
from mo_deepdrive import fronts
from mo_deepdrive.actions import action_table
from mo_deepdrive.objectives import NAMES, scales, signs
from mo_deepdrive.scenarios import SCENARIOS

SHIPPED = sorted(
    (scenario, action_type)
    for scenario in SCENARIOS
    for action_type in ("discrete", "discrete-16", "continuous")
    if (fronts.DATA / f"front_{scenario}_{action_type}.json").is_file()
)
GAMMAS = (0.99, 1.0)


def fixed(scenario: str) -> dict[str, Any]:
    """The arguments that make a scenario the same in every episode."""
    return {"fixed_destination": True, **({"fixed_obstacle": True} if scenario == "static_obstacle" else {})}


def dominates(first: np.ndarray, second: np.ndarray) -> bool:
    return bool((first >= second).all() and (first > second).any())


# -------------------------------------------------------------------------------------------------- reference points


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("action_type", ["discrete", "discrete-16", "continuous"])
@pytest.mark.parametrize("gamma", GAMMAS)
def test_there_is_a_reference_point_for_every_scenario_and_action_type(
    scenario: str, action_type: str, gamma: float
) -> None:
    point = mo_deepdrive.reference_point(scenario, action_type, gamma)
    assert point.objectives == SCENARIOS[scenario].objectives
    assert point.values.shape == (len(point.objectives),)
    assert (point.values < 0.0).all()
    assert point.version >= 1
    assert all(f"{name}: " in point.reason for name in point.objectives)


def test_a_reference_point_follows_the_objectives_asked_for() -> None:
    point = mo_deepdrive.reference_point("static_obstacle", gamma=0.99)
    few = mo_deepdrive.reference_point("static_obstacle", gamma=0.99, objectives=["jerk", "distance"])
    assert few.objectives == ("jerk", "distance")
    assert few.values.tolist() == [point.values[4], point.values[0]]


def test_a_policy_that_stays_where_it_is_lies_a_tenth_of_a_scale_above_the_reference_point() -> None:
    for scenario in SCENARIOS:
        for gamma in GAMMAS:
            point = mo_deepdrive.reference_point(scenario, gamma=gamma)
            np.testing.assert_allclose(point.values[:2], -0.1 * scales(point.objectives[:2]))


@pytest.mark.parametrize("scenario", ["one_waypoint", "static_obstacle"])
@pytest.mark.parametrize("gamma", GAMMAS)
def test_comfort_is_measured_from_what_random_driving_costs(make_vector: Any, scenario: str, gamma: float) -> None:
    env = make_vector(scenario, 512, autoreset_mode="Disabled")
    env.reset(seed=0)
    batch, rng = env.batch, np.random.default_rng(0)
    costs, weight = np.zeros((512, len(env.objectives))), 1.0
    while not batch.over().all():
        batch.step(rng.integers(0, 22, (512, 1)))
        costs -= weight * batch.rewards[:, 0]
        weight *= gamma
    mean = dict(zip(env.objectives, costs.mean(axis=0), strict=True))
    point = mo_deepdrive.reference_point(scenario, gamma=gamma)
    limit = dict(zip(point.objectives, -point.values, strict=True))
    assert limit["g_force"] == pytest.approx(1.5 * mean["g_force"], rel=0.3)
    assert limit["jerk"] == pytest.approx(mean["jerk"], rel=0.2)


def test_a_gamma_without_a_reference_point_is_refused() -> None:
    with pytest.raises(ValueError, match=r"gamma = 0\.95 has no reference point; known: 0\.99, 1\.0"):
        mo_deepdrive.reference_point(gamma=0.95)


@pytest.mark.parametrize("function", [fronts.reference_point, fronts.reference_front])
def test_unknown_names_are_refused_with_the_known_ones(function: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match="scenario = 'one_waypont' is unknown; did you mean 'one_waypoint'"):
        function("one_waypont")
    with pytest.raises(ValueError, match="action_type = 'discreet' is unknown; did you mean 'discrete'"):
        function(action_type="discreet")
    with pytest.raises(ValueError, match="objectives has 'collision', which OneWaypoint lacks"):
        function(objectives=["collision"])


# --------------------------------------------------------------------------------------------------- shipped fronts


def test_the_discrete_fronts_of_both_scenarios_are_shipped() -> None:
    assert {("one_waypoint", "discrete"), ("static_obstacle", "discrete")} <= set(SHIPPED)


@pytest.mark.parametrize(("scenario", "action_type"), SHIPPED)
def test_every_shipped_drive_pays_what_the_file_says(scenario: str, action_type: str) -> None:
    policies = fronts.shipped(scenario, action_type)
    rewards = fronts.replay(scenario, action_type, [fronts.decode(each.actions, action_type) for each in policies])
    for gamma, stored in ((1.0, "undiscounted"), (fronts.GAMMA, "discounted")):
        claimed = np.array([getattr(policy, stored) for policy in policies])
        np.testing.assert_allclose(fronts.discounted_sum(rewards, gamma), claimed, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize(("scenario", "action_type"), SHIPPED)
def test_a_shipped_file_is_small_and_says_where_every_drive_comes_from(scenario: str, action_type: str) -> None:
    text = (fronts.DATA / f"front_{scenario}_{action_type}.json").read_text(encoding="utf-8")
    policies = fronts.read(text)
    assert len(text) < 200_000
    assert 50 <= len(policies) <= 200
    assert len({policy.actions for policy in policies}) == len(policies)
    assert all(policy.source for policy in policies)
    assert fronts.write(scenario, action_type, policies) == text


@pytest.mark.parametrize(("scenario", "action_type"), SHIPPED)
def test_no_shipped_drive_is_dominated_for_both_gammas(scenario: str, action_type: str) -> None:
    policies = fronts.shipped(scenario, action_type)
    on_a_front = np.zeros(len(policies), dtype=bool)
    for gamma, stored in zip(GAMMAS, ("discounted", "undiscounted"), strict=True):
        front = fronts.reference_front(scenario, action_type, gamma)
        assert not any(dominates(other, point) for point in front for other in front)
        claimed = np.array([getattr(policy, stored) for policy in policies])
        on_a_front |= np.isclose(claimed[:, None], front, rtol=1e-5, atol=2e-5).all(axis=2).any(axis=1)
    assert on_a_front.all()


@pytest.mark.parametrize(("scenario", "action_type"), SHIPPED)
@pytest.mark.parametrize("gamma", GAMMAS)
def test_every_point_of_a_front_dominates_the_reference_point(scenario: str, action_type: str, gamma: float) -> None:
    reference = fronts.reference_point(scenario, action_type, gamma).values
    front = fronts.reference_front(scenario, action_type, gamma)
    assert all(dominates(point, reference) for point in front)
    arriving = front[front[:, 1] > 0.0]
    assert len(arriving) > 10
    assert (arriving > reference).all()


@pytest.mark.parametrize(("scenario", "action_type"), SHIPPED)
def test_a_front_reaches_from_staying_to_arriving_in_a_hurry(scenario: str, action_type: str) -> None:
    front = fronts.reference_front(scenario, action_type, 0.99)
    costs = [SCENARIOS[scenario].objectives.index(name) for name in ("g_force", "jerk")]
    assert (np.abs(front[:, costs]) / scales(("g_force", "jerk"))).sum(axis=1).min() < 0.01
    assert front[:, 1].max() > 0.5


def test_a_shipped_drive_can_be_driven_in_the_public_environment(make_single: Any) -> None:
    for scenario, action_type in SHIPPED:
        env = make_single(scenario, action_type=action_type, **fixed(scenario))
        policies = fronts.shipped(scenario, action_type)
        for policy in (policies[0], policies[len(policies) // 2], policies[-1]):
            actions = list(fronts.decode(policy.actions, action_type))
            env.reset(seed=3)
            returns, over = np.zeros(len(env.objectives)), False
            while not over:
                action = actions.pop(0) if actions else fronts.idle(action_type)
                _, reward, terminated, truncated, _ = env.step(action.astype(env.action_space.dtype))
                returns += reward
                over = terminated or truncated
            np.testing.assert_allclose(returns, policy.undiscounted, rtol=1e-5, atol=2e-5)


def test_the_documentation_tells_the_size_of_every_front(repository: Path) -> None:
    text = (repository / "docs" / "fronts.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    told = {tuple(row[:3]): row[3:6] for row in rows if row[0] in SCENARIOS}
    for scenario, action_type in SHIPPED:
        for gamma in GAMMAS:
            front = fronts.reference_front(scenario, action_type, gamma)
            point = fronts.reference_point(scenario, action_type, gamma)
            volume = moocore.hypervolume(front, ref=point.values, maximise=True)
            policies, arriving, told_volume = map(float, told.pop((scenario, action_type, str(gamma))))
            assert (policies, arriving) == (len(front), (front[:, 1] > 0.0).sum())
            assert told_volume == pytest.approx(volume, rel=1e-4)
    assert not told


def test_the_documentation_tells_every_reference_point(repository: Path) -> None:
    text = (repository / "docs" / "fronts.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    told = {(title, row[1]): row[2:] for row in rows if row[1] in ("0.99", "1.0") for title in row[0].split(", ")}
    for scenario in SCENARIOS.values():
        for gamma in GAMMAS:
            numbers = dict(zip(NAMES, told[scenario.title, str(gamma)], strict=True))
            point = mo_deepdrive.reference_point(scenario.name, gamma=gamma)
            assert [float(numbers[name]) for name in point.objectives] == point.values.tolist()


@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.9])
def test_a_front_for_another_gamma_is_discounted_with_it(gamma: float) -> None:
    policies = fronts.shipped("one_waypoint", "discrete")
    rewards = fronts.replay("one_waypoint", "discrete", [fronts.decode(each.actions, "discrete") for each in policies])
    returns = sum(gamma**t * rewards[:, t].astype(np.float64) for t in range(rewards.shape[1]))
    front = mo_deepdrive.reference_front(gamma=gamma)
    assert 1 <= len(front) <= len(policies)
    for point in front:
        assert np.isclose(returns, point, rtol=1e-9, atol=1e-12).all(axis=1).any()
        assert not any(dominates(other, point) for other in front)


def test_a_front_of_fewer_objectives_holds_only_what_these_do_not_dominate() -> None:
    names = ("jerk", "distance")
    full = mo_deepdrive.reference_front()
    front = mo_deepdrive.reference_front(objectives=names)
    columns = full[:, [3, 0]]
    kept = [not any(dominates(other, point) for other in columns) for point in columns]
    assert 1 < len(front) < len(full)
    assert {tuple(point) for point in front} == {tuple(point) for point in columns[kept]}


@pytest.mark.parametrize("gamma", [-0.1, 1.1, float("nan")])
def test_a_gamma_out_of_range_is_refused(gamma: float) -> None:
    with pytest.raises(ValueError, match=r"gamma = .* must lie in \[0, 1\]"):
        mo_deepdrive.reference_front(gamma=gamma)


def test_where_no_front_is_shipped_the_error_names_those_that_are() -> None:
    with pytest.raises(ValueError, match=r"no best-known front is shipped for scenario = 'intersection'.*discrete"):
        mo_deepdrive.reference_front("intersection")


# ---------------------------------------------------------------------------------------------------- environments


@pytest.mark.parametrize(("scenario", "action_type"), SHIPPED)
@pytest.mark.parametrize("gamma", GAMMAS)
def test_an_environment_knows_its_front(
    make_single: Any, make_vector: Any, scenario: str, action_type: str, gamma: float
) -> None:
    expected = fronts.reference_front(scenario, action_type, gamma)
    for make in (make_single, make_vector):
        front = make(scenario, action_type=action_type, **fixed(scenario)).pareto_front(gamma)
        assert isinstance(front, list)
        np.testing.assert_array_equal(np.array(front), expected)


def test_mo_gymnasiums_environment_knows_its_front() -> None:
    env = mo_gymnasium.make("mo-deepdrive-one-waypoint-v0", fixed_destination=True)
    assert len(env.unwrapped.pareto_front(0.99)) == len(mo_deepdrive.reference_front())


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
def test_an_environment_without_a_known_front_says_what_it_would_take(
    make_single: Any, make_vector: Any, scenario: str, options: dict[str, Any], message: str
) -> None:
    for make in (make_single, make_vector):
        with pytest.raises(ValueError, match=message):
            make(scenario, **options).pareto_front(0.99)


def test_the_intersection_has_no_front(make_single: Any, make_vector: Any) -> None:
    for env in (make_single("intersection"), make_vector("intersection")):
        with pytest.raises(ValueError, match="no best-known front is shipped for scenario = 'intersection'"):
            env.pareto_front(0.99)


# ------------------------------------------------------------------------------------------------------- sequences


@given(st.lists(st.integers(0, 21), max_size=40))
def test_what_is_written_of_discrete_actions_is_read_again(actions: list[int]) -> None:
    array = np.array(actions, dtype=np.int64)
    text = fronts.encode(array)
    assert fronts.decode(text, "discrete").tolist() == actions
    assert len(text) <= 2 * len(actions)


@given(st.lists(st.tuples(*[st.integers(-1024, 1024)] * 3), max_size=20))
def test_what_is_written_of_continuous_actions_is_read_again(actions: list[tuple[int, ...]]) -> None:
    array = np.array(actions, dtype=np.float64).reshape(-1, 3) / 1024
    found = fronts.decode(fronts.encode(array), "continuous")
    np.testing.assert_array_equal(found, array)
    np.testing.assert_array_equal(found.astype(np.float32), array)


def test_runs_of_equal_actions_are_written_short() -> None:
    assert fronts.encode(np.array([3, 3, 3, 0, 21])) == "d3av"
    assert fronts.encode(np.array([[0.0, 0.5, -1.0]] * 12 + [[0.25, 0.0, 0.0]])) == "0,512*12 256,0,0"


@pytest.mark.parametrize(
    ("text", "action_type"),
    [
        ("w", "discrete"),
        ("q", "discrete-16"),
        ("a b", "discrete"),
        ("3a", "discrete"),
        ("A", "discrete"),
        ("1", "continuous"),
        ("1,2,3,4", "continuous"),
        ("1,2,3x4", "continuous"),
        ("a3", "continuous"),
        ("1.5,0,0", "continuous"),
    ],
)
def test_what_is_no_sequence_is_refused(text: str, action_type: str) -> None:
    with pytest.raises(ValueError, match="is no sequence of"):
        fronts.decode(text, action_type)


def test_letters_suffice_for_every_discrete_set() -> None:
    assert max(len(action_table(name)) for name in ("discrete", "discrete-16")) <= 26


def test_a_sequence_that_is_over_idles_until_the_episode_is() -> None:
    rewards = fronts.replay(
        "one_waypoint", "discrete", [fronts.decode("", "discrete"), fronts.decode("a600", "discrete")]
    )
    assert rewards.shape == (2, 600, 4)
    assert not rewards.any()
    short, long = fronts.replay("one_waypoint", "continuous", [np.array([[0.0, 0.5, -1.0]] * n) for n in (5, 6)])
    assert not np.array_equal(short, long)
    again = fronts.replay("one_waypoint", "continuous", [np.array([[0.0, 0.5, -1.0]] * 5 + [[0.0, 0.0, -1.0]] * 9)])
    np.testing.assert_array_equal(again[0], short)


def test_importing_the_package_does_not_import_what_fronts_need(run_python: Callable[[str], str]) -> None:
    found = run_python(
        "import sys, mo_deepdrive\nprint('moocore' in sys.modules)\n"
        "mo_deepdrive.reference_point()\nprint('moocore' in sys.modules)"
    )
    assert found.split() == ["False", "True"]


def test_an_unknown_name_of_the_package_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'reference_points'"):
        mo_deepdrive.reference_points  # noqa: B018


def test_a_reference_point_cannot_be_changed() -> None:
    point = mo_deepdrive.reference_point()
    with pytest.raises(dataclasses.FrozenInstanceError):
        point.version = 2  # type: ignore[misc]
