"""A scenario of one's own: a drive to a destination with two bicycles on the way."""

from __future__ import annotations

import math

import effort  # noqa: F401  (registers the objective, which two_bicycles.yaml selects)

from mo_deepdrive import Route, Scenario, register_scenario

register_scenario(
    Scenario(
        name="two_bicycles",
        title="TwoBicycles",
        routes=(Route(start=(7.0, 25.0, -math.pi / 2), waypoints=((20.0, 5.0),)),),
        destination_span=(25.0, 40.0),  # the destination is uniform over [20, 45) x [5, 45) m
        obstacles=2,
        objectives=("distance", "destination", "g_force", "collision", "jerk"),
        reference={"distance": -1.0, "destination": -0.1, "g_force": -25.0, "collision": -1.0, "jerk": -1000.0},
    )
)
