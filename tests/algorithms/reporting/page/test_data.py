"""The data of the explorer's page: exact returns, drives within their resolution."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from algorithms.reporting.page.data import (
    RESOLUTION,
    DiscountedReturns,
    ExplorableFront,
    drive_to_json,
)
from mo_deepdrive.evaluation.drives import POSE, READINGS, Drive, Scene
from mo_deepdrive.utilities import COMFORT_BUDGETS

NAMES = ("distance", "destination", "g_force", "jerk")


def made_up_drive(rng: np.random.Generator, decisions: int, cars: int = 0) -> Drive:
    """A drive with motion in every reading."""
    changes = rng.normal(0, [0.5, 0.5, 0.05, 0.3, 0.05, 5.0], (decisions + 1, 1, len(READINGS)))
    poses = rng.uniform(0, 40, (decisions + 1, cars, 3))
    poses[decisions // 2 :] = np.nan
    return Drive(changes.cumsum(axis=0), poses, ("arrived",))


def made_up_front(policies: int, decisions: int, episodes: int = 1, cars: int = 0) -> ExplorableFront:
    rng = np.random.default_rng(7)
    drives = tuple(made_up_drive(rng, decisions, cars) for _ in range(policies))
    scene = Scene(3, (rng.uniform(0, 40, (2, 2)),), rng.uniform(0, 40, (1, 2, 2)), True, (), 10, drives)
    return ExplorableFront(
        title="made up",
        objectives=NAMES,
        returns=rng.normal(size=(policies, episodes, 4)).astype(np.float32).astype(np.float64),
        scales=np.array([10.0, 1.0, 5.0, 500.0]),
        signs=np.array([1.0, 1.0, -1.0, -1.0]),
        success=rng.uniform(size=policies),
        lengths=np.full(policies, float(decisions)),
        command="mo-deepdrive choose RUN {preference}",
        best_known=rng.normal(size=(200, 4)),
        scenes=(scene,),
        budget_name="one_waypoint_comfort_budget",
        budget=COMFORT_BUDGETS["one_waypoint_comfort_budget"],
    )


def decoded(stored: dict[str, Any], name: str) -> np.ndarray:
    return np.cumsum(stored[name]) * RESOLUTION[name]


@pytest.mark.parametrize(
    ("episodes", "share", "expected"),
    [(20, 1.0, [0.839, 1.0]), (20, 0.5, [0.299, 0.701]), (1, 1.0, None), (9, np.nan, None)],
)
def test_arrivals_have_wilsons_interval(episodes: int, share: float, expected: list[float] | None) -> None:
    front = dataclasses.replace(made_up_front(2, 3, episodes), success=np.array([share, 0.0]))
    assert front.to_json()["successRange"][0] == expected


def test_returns_and_scales_are_exact() -> None:
    front = made_up_front(5, 3, episodes=4)
    stored = front.to_json()
    assert [each["gamma"] for each in stored["returns"]] == [1.0]
    assert np.array_equal(stored["returns"][0]["episodes"], front.returns)
    both = dataclasses.replace(front, discounted=DiscountedReturns(0.9, 0.5 * front.returns)).to_json()["returns"]
    assert np.array_equal(both[1].pop("episodes"), 0.5 * front.returns)
    assert both[1] == {"gamma": 0.9, "bestKnown": []}
    assert [each["scale"] for each in stored["objectives"]] == front.scales.tolist()
    assert [(each["key"], each["unit"], each["sign"]) for each in stored["objectives"]] == [
        ("distance", "m", 1.0),
        ("destination", "", 1.0),
        ("g_force", "g", -1.0),
        ("jerk", "m/s³", -1.0),
    ]
    assert stored["budget"] == {
        "name": "one_waypoint_comfort_budget",
        "g_force": 5.0,
        "jerk": 40.0,
        "gains": {"distance": 0.1, "destination": 10.0},
        "excessPrices": {"g_force": 2.0, "jerk": 0.05},
        "rule": "It has the greatest expected utility. Gains per unit: distance 0.1, destination 10. "
        "Costs per unit: g-force 2 and jerk 0.05 beyond their budgets.",
        "prices": {},
    }


def test_readings_are_rounded_once_however_long_the_drive_is() -> None:
    front = made_up_front(2, 600)
    for drive, stored in zip(front.scenes[0].drives, front.to_json()["scenes"][0]["drives"], strict=True):
        for column, name in enumerate(READINGS):
            worst = np.abs(decoded(stored["vehicles"][0], name) - drive.readings[:, 0, column]).max()
            assert worst <= 0.5 * RESOLUTION[name] * (1 + 1e-6)
        assert stored["vehicles"][0]["end"] == "arrived"
        assert stored["cars"] == []


def test_a_vehicle_is_stored_until_it_has_ended() -> None:
    readings = np.ones((5, 2, len(READINGS)))
    readings[3:, 1] = np.nan
    long, short = drive_to_json(Drive(readings, np.zeros((5, 0, 3)), ("arrived", "collision")))["vehicles"]
    assert (long["end"], short["end"]) == ("arrived", "collision")
    assert (len(long["x"]), short["x"]) == (5, [100, 0, 0])


def test_oncoming_cars_are_stored_where_they_are_present() -> None:
    front = made_up_front(1, 8, cars=2)
    (stored,) = front.to_json()["scenes"][0]["drives"]
    poses = front.scenes[0].drives[0].cars
    assert len(stored["cars"]) == 2
    for car, track in enumerate(stored["cars"]):
        for axis, name in enumerate(POSE):
            np.testing.assert_allclose(decoded(track, name), poses[:4, car, axis], atol=0.0051)


def test_a_car_may_be_absent_for_a_while_or_throughout() -> None:
    along = np.array([np.nan, 2.0, np.nan, 5.0, np.nan])
    cars = np.stack([np.stack([along] * 3, axis=1), np.full((5, 3), np.nan)], axis=1)
    stored = drive_to_json(Drive(np.zeros((5, 1, len(READINGS))), cars, ("arrived",)))
    assert stored["cars"][0] == {name: [None, 2 / step, None, 3 / step] for name, step in list(RESOLUTION.items())[:3]}
    assert stored["cars"][1] == {name: [] for name in POSE}
