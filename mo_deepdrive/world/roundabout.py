"""The lanes of a compact urban roundabout.

Its inscribed circle is in the range of single-lane roundabouts for the smallest of their design vehicles, 90 to 150 ft
("Roundabouts: An Informational Guide", second edition, NCHRP Report 672, 2010, chapter 6); those that the first edition
(B. W. Robinson et al., FHWA-RD-00-067, 2000) calls urban compact are to be entered with at most 25 km/h. Traffic keeps
to the right and circulates counter-clockwise.
"""

from __future__ import annotations

import math

from mo_deepdrive.simulation.state import LENGTH, MAP_CENTRE
from mo_deepdrive.world.routes import Route, Segment

INSCRIBED_DIAMETER = 30.0  # m
LANE_WIDTH = 4.5  # m, of entries, exits and the circulatory roadway
RADIUS = INSCRIBED_DIAMETER / 2 - LANE_WIDTH / 2  # m, of the middle of the circulatory roadway
ENTRY_RADIUS = 12.0  # m, of entries and exits
SPLITTER_ISLAND = 2.0  # m, between the entry and the exit of an arm
APPROACH = 44.0  # m, the straight before the entry
DEPARTURE = 20.0  # m, the straight after the exit
START_SPAN = 4.0  # m
ARMS = 4

# An entry turns right, from the lane of its arm into the circle: its own centre is to the right of the lane, and the
# line between the two centres, through the point where they touch, makes the angle _TURN with the arm.
_OFFSET = (SPLITTER_ISLAND + LANE_WIDTH) / 2
_TURN = math.acos((_OFFSET + ENTRY_RADIUS) / (RADIUS + ENTRY_RADIUS))
# Its centre is this far down the arm, and the front crosses the inscribed circle this far (m) before the circle.
_ALONG_ARM = (RADIUS + ENTRY_RADIUS) * math.sin(_TURN)
_TO_CIRCLE = ENTRY_RADIUS * math.acos(
    ((RADIUS + ENTRY_RADIUS) ** 2 + ENTRY_RADIUS**2 - (INSCRIBED_DIAMETER / 2) ** 2)
    / (2 * (RADIUS + ENTRY_RADIUS) * ENTRY_RADIUS)
)


def _pose(arm: int, side: float, out: float, turned: float) -> tuple[float, float, float]:
    """The pose ``side`` m to the right of an arm, seen by who enters, and ``out`` m from the centre."""
    angle = arm * math.tau / ARMS  # of the heading of who enters; arm 0 is in the south
    cos, sin = math.cos(angle), math.sin(angle)
    return MAP_CENTRE + side * cos + out * sin, MAP_CENTRE + side * sin - out * cos, angle + turned


def roundabout_routes() -> tuple[Route, ...]:
    """The routes from every arm to the three others, those from arm 0 to its right first.

    Who has reached the inscribed circle has right of way until the rear has left it.
    """
    routes = []
    for arm in range(ARMS):
        for exit_arm in range(1, ARMS):
            bend = ENTRY_RADIUS * _TURN
            # The entry ends, and the exit begins, this angle from the arm.
            apart = math.pi / 2 - _TURN
            around = RADIUS * (exit_arm * math.tau / ARMS - 2 * apart)
            to_exit = APPROACH + bend + around
            routes.append(
                Route(
                    start=_pose(arm, _OFFSET, _ALONG_ARM + APPROACH, 0.0),
                    start_span=START_SPAN,
                    segments=(
                        Segment(APPROACH),
                        Segment(bend, -1.0 / ENTRY_RADIUS),
                        Segment(around, 1.0 / RADIUS),
                        Segment(bend, -1.0 / ENTRY_RADIUS),
                        Segment(DEPARTURE),
                    ),
                    end=_pose((arm + exit_arm) % ARMS, -_OFFSET, _ALONG_ARM + DEPARTURE, math.pi),
                    lane_width=LANE_WIDTH,
                    priority=(APPROACH + bend - _TO_CIRCLE, to_exit + _TO_CIRCLE + LENGTH),
                )
            )
    return tuple(routes)
