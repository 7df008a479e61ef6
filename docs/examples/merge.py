"""A road of one's own: a ramp joins a lane, whose traffic has right of way."""

from __future__ import annotations

import math

from mo_deepdrive import Route, Scenario, Segment, register_scenario

END = (25.0, 80.0, 0.0)  # x, y (m) and heading (rad) at the end of both routes
ANGLE, RADIUS = (
    0.35,
    60.0,
)  # at which the ramp comes from the right (rad), and of the bend that joins it to the lane (m)
RAMP, BEND, LANE = 35.0, RADIUS * ANGLE, 60.0  # m

register_scenario(
    Scenario(
        name="merge",
        title="Merge",
        routes=(
            Route(
                start=(25.0, -40.0, 0.0),
                segments=(Segment(60.0), Segment(LANE)),
                end=END,
                lane_width=3.5,
                start_span=10.0,
            ),
            Route(
                start=(
                    25.0 + RADIUS * (1.0 - math.cos(ANGLE)) + RAMP * math.sin(ANGLE),
                    20.0 - RADIUS * math.sin(ANGLE) - RAMP * math.cos(ANGLE),
                    ANGLE,
                ),
                segments=(Segment(RAMP), Segment(BEND, -1.0 / RADIUS), Segment(LANE)),
                end=END,
                lane_width=3.5,
                start_span=10.0,
                priority=(RAMP, RAMP + BEND + LANE),  # those on the ramp give way, as the bend is too close to the lane
            ),
        ),
        number=2,
        cars=2,
        objectives=("distance", "destination", "time", "collision", "lane_violation", "right_of_way"),
        reference={"distance": -1.0, "destination": -0.1, "collision": -1.0, "lane_violation": -100.0},
    )
)
