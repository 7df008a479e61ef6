"""The turn-based Gymnasium environment, in which several vehicles take turns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import ResetNeeded

from mo_deepdrive.envs.world import WorldEnv
from mo_deepdrive.world.config import parse_arguments

if TYPE_CHECKING:
    from numpy.typing import NDArray


class TurnBasedEnv(WorldEnv):
    """Two cars at an intersection, or up to 16 at a roundabout, which take turns.

    ## Description

    Two cars meet at a crossing with one lane per direction: vehicle 0 makes an unprotected left turn across the path
    of vehicle 1, which drives straight on. Based on MO-DeepDrive Zero (Ajridi et al., "Deconstructing Reinforcement
    Learning Benchmarks: Revealing the Objectives", ECAI 2023), whose intersection has this alternating
    form. The cars are kinematic bicycles with friction, simulated at 60 Hz; each decides at 10 Hz.

    The vehicles take turns, and ``info["vehicle"]`` says whose turn it is. ``step`` takes that vehicle's action and
    returns the observation of the vehicle whose turn is next, with the vector reward of that vehicle's own previous
    decision (zeros on its first turn). The world moves when every vehicle on the road has chosen an action, so neither
    sees the other's choice. A vehicle that has ended has one last turn, with its final observation and reward,
    ``info["end"]`` and ``info["success"]``; its action must be in the action space and is ignored. From then on only
    the other vehicle has turns.

    | call | the world | returns | of vehicle |
    |---|---|---|---|
    | ``reset()`` | is placed | first observation | 0 |
    | ``step(a0)`` | waits | first observation, zeros | 1 |
    | ``step(a1)`` | moves by (a0, a1) | observation, reward of a0 | 0 |
    | ``step(b0)`` | waits | observation, reward of a1 | 1 |
    | ``step(b1)`` | moves by (b0, b1); vehicle 1 arrives | observation, reward of b0 | 0 |
    | ``step(c0)`` | waits | final observation, reward of b1, ``"end": "arrived"`` | 1 |
    | ``step(any)`` | moves by c0; vehicle 0 arrives | final observation, reward of c0, ``"end"``, terminated | 0 |

    So every vehicle receives all of its observations and rewards. If several end in the same move, they have their last
    turns in the order of their numbers.

    In Roundabout four vehicles (``vehicles``: 2 to 16) enter a compact urban roundabout with one lane and four arms
    from drawn arms, and leave it at drawn others. Who is inside has right of way. ``cars`` more have scripted drivers,
    which follow the Intelligent Driver Model and give way by gaps; how fast they drive, how close they follow and which
    gap they accept is drawn and hidden.

    ## Action Space

    The action of the vehicle whose turn it is:

    - ``action_type="discrete"`` (default): ``Discrete(22)``. 0 is idle; action 1 + 3 g + c steers by group g (decay,
      small left, small right, micro left, micro right, large left, large right) and changes the speed by c (maintain,
      decrease, increase). ``mo_deepdrive.world.actions.action_names`` lists them.
    - ``"discrete-16"``: ``Discrete(16)``, the older set without the micro groups.
    - ``"continuous"``: ``Box(-1, 1, (3,))``: steer (times 30 degrees, positive to the left), acceleration (times
      3.625 m/s^2) and brake (-1 none, 1 full). Values out of range are clipped.

    ## Observation Space

    ``Box`` of float32 in SI units, 29 numbers (Roundabout 63).

    | index | observation | unit |
    |---|---|---|
    | 0, 1 | angle from the heading to the next waypoint and the one after, positive to the right | rad |
    | 2, 3 | distance from the front to the next waypoint; that, plus the distance from the front to the one after | m |
    | 4, 5 | velocity x, y | m/s |
    | 6, 7 | acceleration x, y | m/s^2 |
    | 8, 9, 10 | held steer, throttle, brake | rad, m/s^2, 1 |
    | 11 | speed | m/s |
    | 12, 13 | distance to the left and right lane line | m |
    | 14 | inside the crossing | 0 or 1 |
    | 15, 16 | the other's velocity x, y relative to its own | m/s |
    | 17, 18 | the other's velocity x, y | m/s |
    | 19, 20 | the other's acceleration x, y | m/s^2 |
    | 21 to 28 | angle and distance to the other's front left, front right, back right, back left corner | rad, m |

    A vehicle that has left the road is observed straight ahead, at rest, at a distance of 100 m.

    In Roundabout the waypoints are the points of the route 6 and 15 m ahead of the front, the crossing is the
    roundabout, and there are, instead of 15 to 28:

    | index | observation | unit |
    |---|---|---|
    | 15, 16 | along the route, from the front to the roundabout (0 from there on), and to the end | m |
    | 17 | heading from the direction of the lane, positive to the left | rad |
    | 18, 19 | nearest vehicle or car: its centre to the right and ahead of one's own | m |
    | 20, 21 | its velocity to the right and ahead | m/s |
    | 22, 23 | cosine and sine of its heading from one's own, positive to the left | 1 |
    | 24, 25, 26 | whether it is inside, whether it has right of way, whether it is there | 0 or 1 |
    | 27 to 62 | the same of the next four | |

    ## Reward Space

    ``Box`` of float32, every component to be maximised (magnitudes with ``cost_sign="paper"``).

    | objective | reward per decision |
    |---|---|
    | distance | route distance gained (m); negative for vehicle 0 in the crossing while vehicle 1 approaches |
    | destination | 1 on the decision that arrives |
    | g_force | minus the g-force at the end of the decision (g) |
    | collision | -1 on the decision that collides, for both vehicles |
    | jerk | minus the jerk at the end of the decision (m/s^3) |
    | lane_violation | minus the distance outside the lane at the end of the decision (m) |
    | time | in v1 and Roundabout: minus the duration of the decision, and the time that an early end leaves (s) |
    | near_miss | Roundabout: -1 on a decision after which the time to collision is below 0.95 s |
    | right_of_way | Roundabout: minus the braking that entering forces on those inside, times the duration (m/s^2 s) |
    | energy | Roundabout: minus the positive work of the traction force per mass (J/kg) |

    In Roundabout the order is distance, destination, time, g_force, jerk, lane_violation, collision, near_miss,
    right_of_way, energy, and distance is the route distance that was gained.

    ## Starting State

    Both cars are at rest in their lanes, each at a random distance from the crossing. ``reset(options={"starts": ((x,
    y, heading), (x, y, heading))})`` sets where, for that episode.

    In Roundabout all are at rest in queues on the arms. Options have a number per vehicle, and after them per car:
    ``routes`` (arm * 3 + exit, which is 0 for the next arm to the right, 1 for the one opposite, 2 for the left) and
    ``distances`` of the front from the start of the route (m); with one number per car ``desired_speeds`` (m/s),
    ``headways`` (s) and ``accepted_gaps`` (s). Of fewer numbers the rest are drawn.

    ## Episode End

    Each vehicle ends separately: ``arrived`` (front within 1 m of the destination), ``collision`` (ends both),
    ``harmful_g_force`` (above 1 g), ``harmful_jerk`` and ``off_lane`` (off by default; in Roundabout always where the
    front is more than a lane's width from the line), ``circling`` (turned by more than 400 degrees),
    ``skipped_waypoint``, ``backwards`` (more than 2 m behind its best route distance), ``time_limit`` (60 s); in
    Roundabout a collision ends those who touch; with ``end_together=True`` the other vehicle ends with the first one
    (``other_vehicle``).
    The episode ends with the last turn of the last vehicle: truncated if that vehicle reached the time limit, otherwise
    terminated. Both flags are False in all turns before, even if a vehicle has ended.

    ## Arguments

    ``scenario`` is set by the id. Every other field of :class:`~mo_deepdrive.world.config.EnvConfig` is an argument:
    ``action_type``, ``time_limit``, ``objectives``, ``cost_sign``, ``simulation_frequency``, ``decision_frequency``,
    ``constrain_controls``, ``ignore_brake``, ``harmful_g_force``, ``harmful_jerk``, ``lane_margin``,
    ``end_on_lane_violation``, ``yield_to_oncoming``, ``end_together``, ``charge_remaining_time``, ``yaw_friction``,
    ``action_delay``; for Roundabout ``vehicles`` and ``cars``. ``render_mode`` is None, "rgb_array" or "human". Unknown
    arguments raise TypeError. (Gymnasium's ``max_episode_steps`` counts turns.)

    ## Version History

    - v1: v0 with ``time`` as the last objective and ``charge_remaining_time=True``, so that ending early saves no time.
    - v0: initial release; Roundabout with ``time`` and ``charge_remaining_time=True``, as the others in v1.
      ``docs/simulator.md`` lists the departures from the published code.

    The version is raised by every change of what an agent experiences: dynamics, rewards, observations, spaces and
    termination. Changes of speed, rendering and documentation keep it.
    """

    def __init__(self, scenario: str, render_mode: str | None = None, **options: Any):
        config = parse_arguments(scenario, options)
        super().__init__(config, render_mode)
        self.vehicles = self.batch.scenario.vehicles
        # Turns per second, so that a video with a frame per turn plays in real time.
        self.metadata["render_fps"] = self.vehicles * config.decision_frequency
        # The vehicles with a turn before the next move, in order; empty outside an episode.
        self._turns: list[int] = []
        self._moved = False
        self._joint = self.world.joint_action()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a new episode with the first turn of vehicle 0; ``options`` set its start (see the class)."""
        self._place(seed, options)
        self._turns = list(range(self.vehicles))
        self._moved = False
        return self.batch.observations[0, 0].copy(), {"vehicle": 0}

    def step(self, action: Any) -> tuple[NDArray[np.float32], NDArray[np.float32], bool, bool, dict[str, Any]]:
        """Choose the action of the vehicle whose turn it is.

        Returns:
            observation (size,), vector reward (d,), terminated, truncated and info of the vehicle whose turn is next,
            which is ``info["vehicle"]``.

        Raises:
            ResetNeeded: before the first reset and after the end of an episode.
            ValueError: for an action outside the action space; nothing changes, and it is still that vehicle's turn.
        """
        if not self._turns:
            raise ResetNeeded("step() before reset() or after the end of an episode")
        batch = self.batch
        vehicle, *waiting = self._turns
        self._joint[0, vehicle] = self.world.checked(action, f"vehicle {vehicle}")
        if not waiting:
            waiting = self.world.on_road()
            self.world.step(self._joint)
            self._moved = True
        vehicle = waiting[0]
        reward = batch.rewards[0, vehicle].copy() if self._moved else np.zeros(self.reward_dim, dtype=np.float32)
        info: dict[str, Any] = {"vehicle": vehicle}
        terminated, truncated = bool(batch.terminated[0, vehicle]), bool(batch.truncated[0, vehicle])
        if terminated or truncated:
            info.update(self.world.end_info(vehicle))
        over = len(waiting) == 1 and not self.world.on_road()
        self._turns = [] if over else waiting
        return batch.observations[0, vehicle].copy(), reward, over and terminated, over and truncated, info
