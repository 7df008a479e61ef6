"""The fixed rules for the roundabout: they find their way, give way, and see no more than an agent."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import mo_deepdrive  # noqa: F401  (registers the ids)
from algorithms.driving.roundabout_rules import (
    SEEN,
    TABLES,
    TYPES,
    RoundaboutDriver,
    RoundaboutRule,
    direction,
    drawn_rule,
    lane,
    locate,
    locate_other,
    look_around,
    make_rule,
)
from algorithms.driving.unskilled import Timed, blind_follower
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.evaluation import Evaluation
from mo_deepdrive.simulation.geometry import HALF_LENGTH
from mo_deepdrive.simulation.state import RUNNING

ROUNDABOUT, SOLO = "mo-deepdrive-roundabout-v0", "mo-deepdrive-roundabout-solo-v0"


def drive(driver: Any, env_id: str = ROUNDABOUT, episodes: int = 40, **arguments: Any) -> Evaluation:
    return evaluate(driver, env_id, episodes=episodes, env_kwargs=arguments, utility="roundabout_linear")


def records(observations: Any) -> Any:
    return observations.astype(np.float64).view(SEEN).reshape(-1)


@pytest.mark.parametrize("actions", ["discrete", "discrete-16", "continuous"])
def test_alone_it_follows_its_lane_to_every_exit(actions: str) -> None:
    found = drive(RoundaboutDriver(RoundaboutRule(), actions), SOLO, cars=0, action_type=actions)
    returns = dict(zip(found.objectives, found.returns[:, 0].mean(axis=0), strict=True))
    assert found.succeeded.all()
    assert returns["lane_violation"] > -1.0
    assert returns["g_force"] > -20.0


@pytest.mark.slow
@pytest.mark.parametrize("name", TYPES)
def test_eight_of_a_kind_arrive_and_the_hurried_sooner(name: str) -> None:
    found = drive(RoundaboutDriver(TYPES[name]), vehicles=8)
    assert found.succeeded.mean() > 0.97
    seconds = found.lengths.mean() / 10.0
    assert seconds == pytest.approx({"hurried": 21.0, "balanced": 24.0, "careful": 30.0}[name], abs=1.5)


@pytest.mark.slow
def test_among_strangers_who_gives_way_arrives_and_the_blind_collide() -> None:
    assert drive(RoundaboutDriver(RoundaboutRule()), SOLO).succeeded.mean() > 0.97
    blind = Timed(0.0, 0.1, blind_follower(RoundaboutRule(), "discrete"))
    assert drive(blind, SOLO).end_rates()["collision"] > 0.1


def test_where_it_is_and_where_others_are_follow_from_the_observation() -> None:
    env: Any = gymnasium.make_vec(ROUNDABOUT, num_envs=8, vehicles=4, autoreset_mode=AutoresetMode.DISABLED).unwrapped
    observations, _ = env.reset(seed=2)
    driver = RoundaboutDriver(RoundaboutRule())
    for _ in range(120):
        state = env.batch.state.reshape(-1)
        running = state["end"] == RUNNING
        seen = records(observations)[running]
        places = [locate(row, TABLES) for row in seen]
        # In the circle it may be on another route, which is the same from there on.
        routes = zip((state["route"][running] % 3).tolist(), state["route_distance"][running].tolist(), strict=True)
        curvatures = [lane(TABLES, place.route, place.along)[2] for place in places]
        assert np.abs(np.subtract(curvatures, [lane(TABLES, *on)[2] for on in routes])).mean() < 5e-3
        # The coordinates are those of the route from the first arm; distances between vehicles are the same ones.
        centres = [place.front - HALF_LENGTH * 1j * direction(place.heading) for place in places]
        others = [locate_other(*each)[0] for each in zip(seen["near"][:, 0], places, strict=True)]
        apart = np.abs(np.subtract(others, centres))
        i = np.repeat(np.arange(8), 4)[running]
        x, y = env.batch.state["x"][i], env.batch.state["y"][i]
        ended = env.batch.state["end"][i] != RUNNING
        expected = np.hypot(x - state["x"][running, None], y - state["y"][running, None])
        expected[ended] = np.inf
        nearest = np.sort(expected, axis=1)[:, 1]
        shown = seen["near"]["present"][:, 0] > 0.5
        np.testing.assert_allclose(apart[shown], nearest[shown], atol=1e-2)
        assert np.isinf(nearest[~shown]).all()
        observations, *_ = env.step(driver(observations))


def test_it_waits_while_somebody_inside_comes_within_the_gap() -> None:
    env: Any = gymnasium.make_vec(ROUNDABOUT, num_envs=64, vehicles=4, autoreset_mode=AutoresetMode.DISABLED).unwrapped
    observations, _ = env.reset(seed=0)
    driver, entered = RoundaboutDriver(TYPES["careful"]), 0
    for _ in range(130):
        before = env.batch.state.copy()
        around = [look_around(row, locate(row, TABLES), TABLES) for row in records(observations)]
        free = np.array(around)[:, 1].reshape(before.shape)
        observations, *_ = env.step(driver(observations))
        enters = (env.batch.state["entered"] >= 0) & (before["entered"] < 0)
        entered += int(enters.sum())
        assert free[enters].min(initial=np.inf) > TYPES["careful"].gap - 2.0  # it cannot stop on the line itself
    assert entered > 100


@pytest.mark.parametrize(("name", "value"), [("gap", -1.0), ("headway", 0.0), ("inside_speed", np.nan)])
def test_numbers_that_make_no_rule_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{name} = {value} of a rule must be a finite number of at least"):
        RoundaboutRule(**{name: value})


def test_names_make_drivers_and_others_are_refused() -> None:
    assert make_rule("rule:careful", "discrete").rule == TYPES["careful"]
    assert make_rule("rule:enters_2.5", "discrete").rule.gap == 2.5
    assert make_rule("rule:drawn_7", "discrete").rule == drawn_rule(7) != drawn_rule(8)
    for name in ("rule:gap_3", "rule:drawn_1.5", "careful"):
        with pytest.raises(ValueError, match=rf"no scripted driver '{name}'; write rule:hurried"):
            make_rule(name, "discrete")
