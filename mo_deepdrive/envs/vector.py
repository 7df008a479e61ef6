"""The native vector environment: N worlds, moved by one call of the kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from mo_deepdrive.envs.options import checked_options, make_pins
from mo_deepdrive.envs.streams import Streams
from mo_deepdrive.envs.vector_base import VectorBase, check_forms, needs_reset, positive
from mo_deepdrive.simulation.autoreset import SAME_STEP
from mo_deepdrive.simulation.state import ARRIVED, ENDS
from mo_deepdrive.support.extras import needed_for
from mo_deepdrive.world.batch import MODES, Transition, WorldBatch

if TYPE_CHECKING:
    from numpy.typing import NDArray


class DrivingVectorEnv(VectorBase):
    """N independent worlds of one scenario, stepped together in compiled code.

    ## Description

    World i behaves bit for bit like the single environment with the seed ``seed + i``. Spaces, rewards and ends are
    those of :class:`mo_deepdrive.envs.single.DrivingEnv` and :class:`mo_deepdrive.envs.turn_based.TurnBasedEnv`.

    ## Shapes

    | array | one vehicle | Intersection (Roundabout: V instead of 2) |
    |---|---|---|
    | actions | (N,) or (N, 3) | (N, 2) or (N, 2, 3) |
    | observations | (N, size) | (N, 2, size) |
    | rewards | (N, d) | (N, 2, d) |
    | terminated, truncated | (N,) | (N, 2) |

    With several vehicles a vehicle's flag stays True from the decision on which it ends until the world is reset, after
    all have ended. ``infos["acted"]`` (N, 2) says which vehicles were on the road in this step, and
    ``infos["arrived"]`` (N, 2), only in steps in which a vehicle ends, which of them arrived in it.

    ## Episode End

    At the end of an episode ``infos["end"]`` says why it ended, and ``infos["success"]`` whether the vehicle arrived
    (per vehicle in Intersection). With SAME_STEP both are in ``infos["final_info"]``, beside ``infos["final_obs"]``
    (rows valid where ``infos["_final_obs"]``).

    ## Version History

    As of the single and the turn-based environment.

    Args:
        num_envs: N.
        scenario: "one_waypoint", "static_obstacle", "intersection", "left_turn", "roundabout", "roundabout_solo" or a
            registered one.
        autoreset_mode: NEXT_STEP (a finished world is reset by the next step, which ignores its action and has zero
            reward), SAME_STEP or DISABLED (``reset(options={"reset_mask": ...})``).
        threads: how many threads share a step, which pays off from about 2,000 worlds. It does not change the results.
        render_mode: None or "rgb_array" (``render()`` returns one frame per world).
        max_episode_steps: number of decisions after which an episode is truncated, unless ``time_limit`` is shorter.
        **options: fields of :class:`mo_deepdrive.world.config.EnvConfig`.

    Raises:
        TypeError: for unknown arguments.
        ValueError: for invalid values.
    """

    end_names = np.array(ENDS, dtype=object)  #: why episodes end, by code

    def __init__(
        self,
        num_envs: int = 1,
        *,
        scenario: str,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 1,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **options: Any,
    ):
        threads = positive("threads", threads)
        super().__init__(num_envs, scenario, autoreset_mode, render_mode, max_episode_steps, options)
        self.batch = WorldBatch(self.config, self.num_envs, threads)
        self._make_spaces(self.batch.scenario.vehicles)
        self._streams: Streams | None = None
        self._begun = False
        # Worlds whose episode is over and which have not been reset (NEXT_STEP and DISABLED).
        self._over = np.ones(self.num_envs, dtype=np.bool_)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of every world."""
        return tuple(self.streams.seeds)

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generator of every world."""
        return self.streams.generators

    @property
    def streams(self) -> Streams:
        """The random stream of every world."""
        if self._streams is None:
            self._streams = Streams([None] * self.num_envs, self.batch.scenario.draws)
        return self._streams

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start new episodes.

        An int seeds world i with ``seed + i``; a list has a seed per world; None continues the streams. The option
        ``"reset_mask"`` (N,) bool resets only those worlds; the others are those of the single environment. A
        ValueError for invalid seeds or options, where no world changes.
        """
        options = checked_options(options)
        mask = self._mask(options.pop("reset_mask", None))
        pins = make_pins(options, self.config)
        seeds = self._seeds(seed)
        # With options no draw may be valid, which shows when the streams have moved on.
        first = self._streams is None
        before = None if pins is None else (self.get_state(), list(self.streams.seeds))
        if first:
            self._streams = Streams(seeds, self.batch.scenario.draws)
        else:
            self.streams.reseed(seeds, mask)
        try:
            self.batch.place(self.streams, mask, pins)
        except ValueError:
            if before is not None:
                state, self.streams.seeds = before
                self.set_state(state)
            raise
        self._over[mask] = False
        self._begun = True
        return self._shaped(self.batch.observations.copy()), {}

    def _mask(self, mask: Any) -> NDArray[np.bool_]:
        if mask is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (self.num_envs,):
            raise ValueError(f"reset option 'reset_mask' = {mask!r} must be a bool array of shape ({self.num_envs},)")
        if not mask.any():
            raise ValueError("reset option 'reset_mask' must have at least one True")
        return mask

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Move every world by one decision; see the class for shapes and infos."""
        taken = self.advance(self._batched(actions))
        infos: dict[str, Any] = {}
        if self.vehicles > 1:
            infos |= {"acted": taken.acted, "_acted": np.ones(self.num_envs, dtype=np.bool_)}
            ended = taken.acted & (taken.terminated | taken.truncated)
            if (mask := ended.any(axis=1)).any():
                infos |= {"arrived": ended & (taken.ends == ARRIVED), "_arrived": mask}
        if taken.over.any():
            ends = self._ends(taken)
            if self.autoreset_mode is AutoresetMode.SAME_STEP:
                infos["final_obs"], infos["_final_obs"] = self._shaped(taken.final), taken.over
                infos["final_info"], infos["_final_info"] = ends, taken.over
            else:
                infos.update(ends)
        shaped = (taken.observations, taken.rewards, taken.terminated, taken.truncated)
        observations, rewards, terminated, truncated = map(self._shaped, shaped)
        return observations, rewards, terminated, truncated, infos

    def advance(self, actions: NDArray[Any]) -> Transition:
        """What :meth:`step` does, without infos, which take as long as the physics, and with an axis of one vehicle.

        No later step overwrites the arrays. The actions are (N, V) or (N, V, 3). ResetNeeded as :meth:`check_ready`; a
        ValueError for actions that are not in the action space, where no world has moved.
        """
        self.check_ready()
        batch = self.batch
        batch.step(actions)
        at_once = self.autoreset_mode is AutoresetMode.SAME_STEP
        if not at_once:
            batch.reset(MODES[self.autoreset_mode], self._over, self.streams)
        over = batch.over()
        observations = batch.observations.copy()
        taken = Transition(
            observations,
            observations,
            batch.rewards.copy(),
            batch.acted.copy(),
            batch.terminated.copy(),
            batch.truncated.copy(),
            over,
            batch.state["end"].copy(),
        )
        if at_once and over.any():
            batch.reset(SAME_STEP, self._over, self.streams)
            taken = taken._replace(observations=batch.observations.copy())
        return taken

    def check_ready(self) -> None:
        """Refuse to step worlds that have to be reset first, with ResetNeeded.

        That is before the first reset, or where a world's episode is over and this mode does not reset it.
        """
        if self.autoreset_mode is not AutoresetMode.NEXT_STEP and self._over.any():
            raise needs_reset(np.flatnonzero(self._over))
        if not self._begun:
            raise ResetNeeded("step() before the first reset()")

    def _batched(self, actions: Any) -> NDArray[Any]:
        """``actions`` as the batch takes them: (N, vehicles) or (N, vehicles, 3)."""
        array = np.asarray(actions)
        if array.shape != self.action_space.shape:
            raise ValueError(f"actions have shape {array.shape}; expected {self.action_space.shape}")
        return array[:, None] if self.vehicles == 1 else array

    def _ends(self, taken: Transition) -> dict[str, Any]:
        """Why the episodes that are over ended, in the form of Gymnasium's vector infos."""
        over, codes = taken.over, self._shaped(taken.ends)
        end, success = np.full(codes.shape, None, dtype=object), np.zeros(codes.shape, dtype=np.bool_)
        end[over], success[over] = self.end_names[codes[over]], codes[over] == ARRIVED
        return {"end": end, "_end": over.copy(), "success": success, "_success": over.copy()}

    def _states(self) -> NDArray[Any]:
        return self.batch.state

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Everything that determines the future, as plain arrays; :meth:`set_state` resumes from it exactly."""
        return {
            "state": self.batch.state.view(np.uint8).copy(),
            "over": self._over.copy(),
            "begun": np.array([self._begun]),
            **self.streams.get_state(),
        }

    def set_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Resume from the result of :meth:`get_state` of an environment with the same arguments.

        A ValueError if the state is of an environment of another size or version, or has values that no environment can
        reach; nothing changes.
        """
        check_forms(state, self.get_state())
        for name in ("over", "begun"):
            if (flags := state[name].view(np.uint8)).max() > 1:
                raise ValueError(f"state {name!r} has {flags.max()}; it must be 0 or 1")
        Streams.check(state)
        self.batch.restore(np.ascontiguousarray(state["state"]).view(self.batch.state.dtype))
        self._over = state["over"].copy()
        self._begun = bool(state["begun"][0])
        self.streams.set_state(state)

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the renderers: a copy or pickle continues exactly from here."""
        return {**self.__dict__, "_viewers": []}

    def close_extras(self, **_kwargs: Any) -> None:
        """End the threads and close the renderers."""
        self.batch.close()
        super().close_extras()


def make_vector_env(num_envs: int = 1, *, device: str | None = None, **arguments: Any) -> VectorBase:
    """What ``gymnasium.make_vec`` makes of the ids of this package.

    Without a ``device`` it is :class:`DrivingVectorEnv`; with "cpu" or "cuda" one of PyTorch's tensors on that device,
    :class:`mo_deepdrive.envs.device.DeviceVectorEnv`. Arguments and errors are theirs.
    """
    if device is None:
        return DrivingVectorEnv(num_envs, **arguments)
    if "threads" in arguments:
        raise ValueError(f"threads = {arguments['threads']!r} has no effect with device = {device!r}; omit it")
    with needed_for(f"device = {device!r}", "cuda"):
        from mo_deepdrive.envs.device import DeviceVectorEnv

    return DeviceVectorEnv(num_envs, device=device, **arguments)
