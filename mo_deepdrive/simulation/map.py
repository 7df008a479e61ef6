"""The square on which scenarios are drawn, and the crossing in its middle."""

from mo_deepdrive.simulation.state import LANE_WIDTH, LENGTH

# The original draws on a 1000 px square with a 50 px margin.
PIXELS_PER_METRE = 405 / LENGTH / 4
MAP_UNIT = 900 / PIXELS_PER_METRE
MAP_ORIGIN = 50 / PIXELS_PER_METRE
MAP_CENTRE = MAP_ORIGIN + MAP_UNIT / 2
MAP_SIZE = 1000 / PIXELS_PER_METRE

HALF_LANE = LANE_WIDTH / 2
