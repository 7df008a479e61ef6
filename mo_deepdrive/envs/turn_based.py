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

    ## Spaces and ends

    Spaces are those of one vehicle: ``Discrete(22)``, ``Discrete(16)`` or ``Box(-1, 1, (3,))`` for the action of the
    vehicle whose turn it is, by ``action_type``; observations of float32 in SI units, 29 numbers or 63 in Roundabout;
    rewards of float32 with a number per objective, every one to be maximised. ``docs/environments`` says what each
    number is, which reset options and arguments (fields of :class:`~mo_deepdrive.world.config.EnvConfig`) there are,
    and why vehicles end. The episode ends with the last turn of the last vehicle: truncated if that vehicle reached the
    time limit, otherwise terminated. Both flags are False in all turns before, even if a vehicle has ended.
    (Gymnasium's ``max_episode_steps`` counts turns.)

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
        self._joint = self.joint_action()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a new episode with the first turn of vehicle 0; ``options`` set its start."""
        self._start(seed, options)
        self._turns = list(range(self.vehicles))
        self._moved = False
        return self.batch.observations[0, 0].copy(), {"vehicle": 0}

    def step(self, action: Any) -> tuple[NDArray[np.float32], NDArray[np.float32], bool, bool, dict[str, Any]]:
        """Choose the action of the vehicle whose turn it is.

        Returns observation (size,), vector reward (d,), terminated, truncated and info of the vehicle whose turn is
        next, which is ``info["vehicle"]``. ResetNeeded before the first reset and after the end of an episode; a
        ValueError for an action outside the action space, where nothing changes, and it is still that vehicle's turn.
        """
        if not self._turns:
            raise ResetNeeded("step() before reset() or after the end of an episode")
        batch = self.batch
        vehicle, *waiting = self._turns
        self._joint[0, vehicle] = self.checked(action, f"vehicle {vehicle}")
        if not waiting:
            waiting = self.on_road()
            self.move(self._joint)
            self._moved = True
        vehicle = waiting[0]
        reward = batch.rewards[0, vehicle].copy() if self._moved else np.zeros(self.reward_dim, dtype=np.float32)
        info: dict[str, Any] = {"vehicle": vehicle}
        terminated, truncated = bool(batch.terminated[0, vehicle]), bool(batch.truncated[0, vehicle])
        if terminated or truncated:
            info.update(self.end_info(vehicle))
        over = len(waiting) == 1 and not self.on_road()
        self._turns = [] if over else waiting
        return batch.observations[0, vehicle].copy(), reward, over and terminated, over and truncated, info
