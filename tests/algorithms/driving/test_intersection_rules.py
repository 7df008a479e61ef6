"""The scripted drivers of the intersection: they arrive where the other lets them, and see no more than an agent."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import mo_deepdrive  # noqa: F401  (registers the ids)
from algorithms.driving.intersection_rules import (
    SCENARIO,
    SEEN,
    STRANGERS,
    TRAINING_PARTNERS,
    as_in_left_turn,
    make_rule,
    room_ahead,
)
from algorithms.driving.left_turn_rules import COLUMN
from algorithms.driving.named_rules import ScriptedPolicy
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.evaluation import Evaluation
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.evaluation.team import Team
from mo_deepdrive.simulation.state import RUNNING
from mo_deepdrive.simulation.traffic import ENTRY

ACTIONS = pytest.mark.parametrize("actions", ["discrete", "continuous"])


def drive(first: str, second: str, actions: str = "discrete", episodes: int = 100) -> Evaluation:
    arguments = {"action_type": actions}
    env = EnvAdapter(make_env(SCENARIO.id, 1, arguments))
    members = [ScriptedPolicy(env, v, make_rule(name, actions)) for v, name in enumerate((first, second))]
    return evaluate(Team(members), SCENARIO.id, episodes=episodes, env_kwargs=arguments)


@ACTIONS
@pytest.mark.parametrize("straight", ["rule:straight_3", "rule:straight_6", "rule:yields_3", "rule:yields_6"])
def test_both_arrive_if_the_left_turner_waits_long_enough(straight: str, actions: str) -> None:
    evaluation = drive("rule:gap_8", straight, actions)
    assert evaluation.succeeded.mean(axis=0).min() >= 0.95
    lanes = evaluation.objectives.index("lane_violation")
    assert evaluation.returns[:, :, lanes].mean() > -3.0


def test_who_waits_for_nobody_collides_and_braking_helps() -> None:
    collided = {
        name: drive("rule:gap_0", name).end_rates()["collision"] for name in ("rule:straight_6", "rule:yields_6")
    }
    assert collided["rule:straight_6"] > 0.5
    assert collided["rule:yields_6"] < collided["rule:straight_6"] - 0.1


def test_a_slower_driver_takes_longer() -> None:
    slow, fast = (drive("rule:gap_8", f"rule:straight_{speed}", episodes=20).lengths[:, 1] for speed in (2.5, 6))
    assert slow.min() > fast.max()


def test_what_is_derived_from_the_observation_is_the_simulators() -> None:
    env = gymnasium.make_vec(SCENARIO.id, num_envs=20)
    observations, _ = env.reset(seed=3)
    drivers = [make_rule("rule:gap_3", "discrete"), make_rule("rule:straight_4", "discrete")]
    compared = 0
    for _ in range(60):
        state = env.unwrapped.batch.state  # type: ignore[attr-defined]
        both = (state["end"] == RUNNING).all(axis=1)
        seen = as_in_left_turn(observations[:, 0].astype(np.float64))
        distance, speed = seen[:, COLUMN["oncoming_1_distance"]], seen[:, COLUMN["oncoming_1_speed"]]
        here = both & (state[:, 0]["next_waypoint"] == 0) & (distance < 100.0)
        np.testing.assert_allclose(distance[here], state[here, 1]["front_y"] - ENTRY, atol=0.1)
        np.testing.assert_allclose(speed[here], -state[here, 1]["vy"], atol=1e-5)
        compared += int(here.sum())
        actions = [driver(observations[:, v]) for v, driver in enumerate(drivers)]
        observations, *_ = env.step(np.stack(actions, axis=1))
    assert compared > 100


def test_a_vehicle_that_has_left_the_road_is_in_nobodys_way() -> None:
    env = gymnasium.make_vec(SCENARIO.id, num_envs=1)
    observations, _ = env.reset(seed=0)
    seen = observations[:, 1].astype(np.float64)
    for name in SEEN:
        if name.startswith("other_"):
            seen[:, SEEN[name]] = 100.0 if name.endswith("distance") else 0.0
    assert room_ahead(seen).tolist() == [np.inf]
    seen[:, SEEN["other_vy"]] = 1.0  # one that drives is there
    assert np.isfinite(room_ahead(seen)).all()
    absent = as_in_left_turn(np.where(seen == 1.0, 0.0, seen))
    assert absent[:, COLUMN["oncoming_1_distance"]].tolist() == [100.0]


@ACTIONS
def test_a_script_is_a_policy_of_one_vehicle_and_the_other_idles(actions: str) -> None:
    env = EnvAdapter(make_env(SCENARIO.id, 4, {"action_type": actions}))
    observations = env.reset(5)
    past = AccruedReward.begin(4, 2, len(env.objectives))
    chosen = ScriptedPolicy(env, 1, make_rule("rule:straight_6", actions)).act(observations, past, None)
    expected = make_rule("rule:straight_6", actions)(observations[:, 1])
    np.testing.assert_allclose(env.environment_actions(chosen)[:, 1], expected, rtol=1e-6)
    idle = ScriptedPolicy(env).act(observations, past, None)
    assert not env.environment_actions(idle).any()
    np.testing.assert_array_equal(chosen[:, 0], idle[:, 0])


@pytest.mark.parametrize("name", ["rule:gap", "rule:gap_-1", "rule:turns_3", "gap_3", "rule:gap_3 "])
def test_an_unknown_rule_is_refused_with_the_forms_that_exist(name: str) -> None:
    with pytest.raises(ValueError, match=rf"no scripted driver '{name}'; write rule:gap_NUMBER, rule:straight_NUMBER"):
        make_rule(name, "discrete")


def test_families_of_drivers_do_what_they_are_called() -> None:
    def lengths(name: str) -> Any:
        return drive("rule:gap_99", name, episodes=20).lengths[:, 1]

    parked = drive("rule:gap_5", "rule:parked_6", episodes=20)
    assert parked.end_rates(1)["time_limit"] == 1.0
    assert parked.succeeded[:, 0].mean() > 0.9
    assert lengths("rule:creeps_0.5").min() > 200 > lengths("rule:late_6").max()
    assert lengths("rule:waves_4").min() > lengths("rule:straight_4").max()
    # One that waits for the other to turn comes last; one that only stops before somebody who moves comes first.
    waits, stops = (drive("rule:gap_5", name, episodes=20).lengths for name in ("rule:courteous_4", "rule:stops_1"))
    assert (waits[:, 0] < waits[:, 1]).all()
    assert stops[:, 1].mean() < waits[:, 1].mean()


def test_no_family_that_is_trained_with_is_met_as_a_stranger() -> None:
    families = [{name.rpartition("_")[0] for name in names} for names in (TRAINING_PARTNERS, STRANGERS)]
    assert not families[0] & families[1]
    for name in (*TRAINING_PARTNERS, *STRANGERS):
        assert make_rule(name, "discrete").vehicle == 1
