"""All interfaces agree: the same seed and joint actions give the same trajectories, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

import mo_deepdrive
from tests.helpers.interfaces import (
    ACTION_TYPES,
    INTERFACES,
    PLANS,
    assert_same,
    record,
    record_roundabout,
    replay_vector,
)


@pytest.mark.slow
@pytest.mark.parametrize("end_together", [False, True])
@pytest.mark.parametrize("action_type", ACTION_TYPES)
def test_the_recorded_episodes_end_as_planned(action_type: str, end_together: bool) -> None:
    episodes = replay_vector(record(action_type, end_together))
    wanted = [plan.ends_together if end_together else plan.ends for plan in PLANS.values()]
    assert [tuple(reports[-1].end for reports in episode) for episode in episodes] == wanted
    lengths = {name: [len(reports) for reports in episode] for name, episode in zip(PLANS, episodes, strict=True)}
    early = [name for name, (left, straight) in lengths.items() if left != straight]
    if end_together:
        assert early == []
    else:
        # One vehicle continues after the other has arrived or failed, whichever it is.
        assert early == ["both arrive", "the straight one fails", "the left turn fails", "one arrives, one stays"]
        assert lengths["both arrive"][0] > lengths["both arrive"][1]
        assert lengths["the left turn fails"][0] < lengths["the left turn fails"][1]


@pytest.mark.slow
@pytest.mark.parametrize("end_together", [False, True])
@pytest.mark.parametrize("action_type", ACTION_TYPES)
@pytest.mark.parametrize("interface", [name for name in INTERFACES if name != "vector"])
def test_every_interface_gives_the_trajectories_of_the_vector_interface(
    interface: str, action_type: str, end_together: bool
) -> None:
    recording = record(action_type, end_together)
    assert_same(INTERFACES[interface](recording), replay_vector(recording))


@pytest.mark.slow
@pytest.mark.parametrize(("vehicles", "cars"), [(4, 0), (16, 0), (3, 2)])
def test_every_interface_gives_the_same_trajectories_of_many_vehicles(vehicles: int, cars: int) -> None:
    recording = record_roundabout(vehicles, cars)
    episodes = replay_vector(recording)
    for interface in INTERFACES.values():
        assert_same(interface(recording), episodes)
    ends = {reports[-1].end for episode in episodes for reports in episode}
    assert ends >= {"arrived", "collision"}


@pytest.mark.slow
@pytest.mark.parametrize("end_together", [False, True])
def test_every_interface_delays_actions_and_charges_the_time_that_remains(end_together: bool) -> None:
    recording = record("discrete", end_together, late_v1=True)
    episodes = replay_vector(recording)
    for interface in INTERFACES.values():
        assert_same(interface(recording), episodes)
    ends = set()
    for reports in (reports for episode in episodes for reports in episode):
        charged = -sum(float(report.reward[-1]) for report in reports)
        driven = 0.1 * (len(reports) - 1)
        assert charged == pytest.approx(driven if reports[-1].end == "arrived" else 60.0, rel=1e-5)
        ends.add(reports[-1].end)
    assert ends >= {"arrived", "collision", "other_vehicle" if end_together else "time_limit"}


@pytest.mark.parametrize("options", [5, [], "starts", {1: 2}, np.zeros(2)], ids=repr)
@pytest.mark.parametrize(
    "make",
    [
        lambda: gymnasium.make("mo-deepdrive-one-waypoint-v0").unwrapped,
        lambda: gymnasium.make("mo-deepdrive-intersection-v0").unwrapped,
        lambda: gymnasium.make_vec("mo-deepdrive-one-waypoint-v0", num_envs=2),
        lambda: gymnasium.make_vec("mo-deepdrive-one-waypoint-v0", num_envs=2, device="cpu"),
        mo_deepdrive.parallel_env,
        mo_deepdrive.env,
    ],
    ids=["single", "turn-based", "vector", "tensor", "parallel", "AEC"],
)
def test_every_interface_refuses_reset_options_that_are_not_a_dict(make: Callable[[], Any], options: Any) -> None:
    with pytest.raises(ValueError, match=r"options = .* must be a dict of reset options by name, or None"):
        make().reset(options=options)
