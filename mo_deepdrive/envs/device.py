"""The vector environment of tensors, on a GPU or on the CPU."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode

from mo_deepdrive.device.worlds import TensorWorlds, make_streams
from mo_deepdrive.envs.options import checked_options, make_pins
from mo_deepdrive.envs.vector_base import VectorBase, check_forms, needs_reset
from mo_deepdrive.simulation import philox
from mo_deepdrive.simulation.philox import STREAM
from mo_deepdrive.simulation.state import ARRIVED
from mo_deepdrive.world.batch import Draws, Transition, WorldBatch

if TYPE_CHECKING:
    from numpy.typing import NDArray

LARGEST_SEED = 2**64 - 1


class _Episode:
    """The random numbers of the next episode of a stream, drawn on the CPU; a Generator for :class:`Draws`."""

    def __init__(self, stream: NDArray[Any]):
        self._stream = stream
        self._attempts = 0

    def random(self, out: NDArray[np.float64]) -> None:
        philox.draw(self._stream, self._attempts, out, 0)
        self._attempts += 1


class DeviceVectorEnv(VectorBase):
    """N independent worlds of one scenario, whose observations, rewards, flags and actions are tensors on a device.

    ``gymnasium.make_vec(id, num_envs=65536, device="cuda")`` makes it. Arguments, spaces, shapes, autoreset modes and
    reset options are those of :class:`mo_deepdrive.envs.vector.DrivingVectorEnv`, and from the same state and actions
    come the same trajectories, on a GPU up to rounding. Other libraries take the tensors by DLPack.

    ## Random numbers

    ``reset(seed=7)`` draws episodes on the device: each is a function of the seed, the number of the environment and
    the number of the episode there, so the number of environments does not change it. A list with a seed per world
    draws the first episodes as on the CPU, so they are the same scenarios; later ones are drawn on the device.

    ## Infos

    Nothing waits for the device, so infos are tensors, too, and there in every step: ``end`` (int8, positions in
    :data:`mo_deepdrive.simulation.state.ENDS`) and ``success``, with several vehicles ``acted`` and ``arrived``; each
    is valid where the mask of the same name with an underscore says so. With SAME_STEP ``end`` and ``success`` are in
    ``final_info``, beside ``final_obs``, all of whose rows are valid.

    ## Errors

    For the same reason an action that is not allowed, or a step of a world that had to be reset, raises an error in a
    later step, in the next reset of all worlds or in :meth:`get_state`. ``check_actions=True`` waits, and raises it
    before any world has moved.

    Besides the arguments of the other environment there are ``device``, "cpu", "cuda" or one of several GPUs, as
    "cuda:1", and ``check_actions``, but no ``threads``.

    Raises:
        ImportError: if the device needs packages that are not installed.
        TypeError: for unknown arguments.
        ValueError: for invalid values, a device that does not exist or has too little memory, or an objective that
            cannot be compiled for it.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        scenario: str,
        device: str,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        check_actions: bool = False,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **options: Any,
    ):
        super().__init__(num_envs, scenario, autoreset_mode, render_mode, max_episode_steps, options)
        self.worlds = TensorWorlds(self.config, self.num_envs, device, self.autoreset_mode)
        self._make_spaces(self.worlds.vehicles)
        self.device = self.worlds.device
        self.check_actions = check_actions
        # The last fault that is known here; a GPU writes it when it gets there.
        self._fault = torch.zeros(1, dtype=torch.int64, pin_memory=self.device.type == "cuda")
        self._begun = False

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of every world; this waits for the device."""
        return tuple(self.worlds.read_streams()["seed"].tolist())

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: an int seeds all worlds, which draw numbers of their own; a list has a seed per world, whose first
                episode is that of the CPU's environments; None continues the streams.
            options: ``"reset_mask"`` (N,) bool, a tensor on the device or an array, resets only those worlds; other
                options as in the single environment.

        Raises:
            ResetNeeded: for a step of a world that had to be reset.
            ValueError: for invalid seeds or options (no world changes), or an action that was not allowed.
        """
        options = checked_options(options)
        mask = self._mask(options.pop("reset_mask", None))
        pins = make_pins(options, self.config)
        listed = isinstance(seed, (list, tuple, np.ndarray))
        seeds = self._seeds(seed)
        given = seeds if listed else seeds[:1]
        if (largest := max((each for each in given if each is not None), default=0)) > LARGEST_SEED:
            raise ValueError(f"seed {largest} must be at most 2**64 - 1 in an environment with a device")
        if self._begun and seed is None and pins is None:
            if mask is None:
                self.worlds.check()
            self.worlds.next_episodes(mask)
        else:
            self.worlds.check()
            rows = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask.cpu().numpy())
            self._start(rows, seeds, pins, listed)
            self.worlds.check()
        self._begun = True
        return self._shaped(self.worlds.observations.clone()), {}

    def _start(self, rows: NDArray[np.int64], seeds: list[int | None], pins: Any, listed: bool) -> None:
        """Start episodes in the worlds ``rows`` (k,); those with a seed of their own, or pins, are placed on the CPU.

        The seeds are of all worlds, and None continues a stream. Where they are not ``listed``, one for each, the first
        one is that of all.
        """
        everyone = np.arange(self.num_envs)
        if self._begun:
            streams = self.worlds.read_streams()
        else:
            streams = make_streams(np.full(self.num_envs, seeding.np_random(None)[1] % LARGEST_SEED), everyone)
        generators: dict[int, Any] = {}
        for row in rows.tolist():
            if listed and (seed := seeds[row]) is not None:
                streams[row] = (seed, 0, 0)
                generators[row] = seeding.np_random(seed)[0]
        if not listed and seeds[0] is not None:
            streams[rows] = make_streams(np.full(len(rows), seeds[0], dtype=np.uint64), rows)
        on_host = rows if pins is not None else np.array(sorted(generators), dtype=np.int64)
        batch = None
        if len(on_host):
            sources: list[Any] = [generators.get(row) or _Episode(streams[row]) for row in on_host.tolist()]
            batch = WorldBatch(self.config, len(on_host))
            batch.place(Draws(len(on_host), batch.scenario.draws, sources), pins=pins)
            streams["episode"][on_host] += 1
        # Nothing is refused from here on.
        self.worlds.write_streams(streams)
        elsewhere = np.zeros(self.num_envs, dtype=np.bool_)
        elsewhere[rows] = True
        elsewhere[on_host] = False
        if elsewhere.any():
            self.worlds.next_episodes(torch.from_numpy(elsewhere).to(self.device))
        if batch is not None:
            self.worlds.write_states(batch.state, on_host)

    def _mask(self, mask: Any) -> torch.Tensor | None:
        if isinstance(mask, np.ndarray):
            mask = torch.from_numpy(mask).to(self.device)
        if mask is None:
            return None
        expected = torch.bool, self.device, (self.num_envs,)
        if not isinstance(mask, torch.Tensor) or (mask.dtype, mask.device, tuple(mask.shape)) != expected:
            allowed = f"a bool tensor of shape ({self.num_envs},) on {self.device}, or such an array"
            raise ValueError(f"reset option 'reset_mask' = {mask!r} must be {allowed}")
        return mask

    def step(
        self, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Move every world by one decision; see the class for infos and for errors of earlier steps.

        The actions, on the device, are int64 (N,) or (N, V), or float32 with a last axis of 3; anything else is a
        ValueError. ResetNeeded before the first reset, or where a world's episode was over and this mode does not reset
        it.
        """
        if not self._begun:
            raise ResetNeeded("step() before the first reset()")
        self._check_form(actions)
        if self.check_actions:
            self._check_step(actions)
        self.worlds.step(actions[:, None] if self.vehicles == 1 else actions)
        taken = self.worlds.snapshot()
        self._find_faults()
        observations, rewards, terminated, truncated = map(
            self._shaped, (taken.observations, taken.rewards, taken.terminated, taken.truncated)
        )
        return observations, rewards, terminated, truncated, self._infos(taken)

    def _infos(self, taken: Transition) -> dict[str, Any]:
        over = taken.over
        arrived = taken.ends == ARRIVED
        ends = {"end": self._shaped(taken.ends), "_end": over}
        ends |= {"success": self._shaped(arrived), "_success": over}
        infos: dict[str, Any] = {}
        if self.vehicles > 1:
            ended = taken.acted & (taken.terminated | taken.truncated)
            infos |= {"acted": taken.acted, "_acted": torch.ones_like(over)}
            infos |= {"arrived": arrived & ended, "_arrived": ended.any(dim=1)}
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            infos |= {"final_obs": self._shaped(taken.final), "_final_obs": over}
            return {**infos, "final_info": ends, "_final_info": over}
        return infos | ends

    def _check_form(self, actions: Any) -> None:
        if not isinstance(actions, torch.Tensor):
            raise ValueError(
                f"actions are of type {type(actions).__name__!r}; this environment takes tensors on {self.device}: "
                f"torch.as_tensor(actions, device={str(self.device)!r})"
            )
        dtype = torch.float32 if self.worlds.continuous else torch.int64
        for what, found, expected in (
            ("are on", actions.device, self.device),
            ("have dtype", actions.dtype, dtype),
            ("have shape", tuple(actions.shape), self.action_space.shape),
        ):
            if found != expected:
                raise ValueError(f"actions {what} {found}; expected {expected}")

    def _check_step(self, actions: torch.Tensor) -> None:
        """Refuse what cannot be stepped, before it is; this waits for the device."""
        worlds = self.worlds
        fine = actions.isfinite() if worlds.continuous else (actions >= 0) & (actions < worlds.choices)
        fine = fine.view(self.num_envs, -1).all(dim=1)
        if not bool(fine.all()):
            row = int((~fine).nonzero()[0])
            raise ValueError(
                f"action {actions[row].tolist()} of world {row} is not allowed; expected {worlds.allowed_actions}"
            )
        if self.autoreset_mode is not AutoresetMode.NEXT_STEP and bool(worlds.waiting.any()):
            raise needs_reset(worlds.waiting.nonzero()[:, 0])

    def _find_faults(self) -> None:
        """Raise the error of a step before, if it is known by now."""
        self._fault.copy_(self.worlds.fault, non_blocking=True)
        if int(self._fault):
            try:
                self.worlds.check()
            finally:
                self._fault.zero_()

    def _states(self) -> NDArray[Any]:
        return self.worlds.read_states()

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Everything that determines the future, as plain arrays; :meth:`set_state` resumes from it exactly.

        This waits for the device, and raises errors of earlier steps. ``state`` is that of the CPU's environment.
        """
        self.worlds.check()
        streams = self.worlds.read_streams().view(np.uint8).reshape(self.num_envs, STREAM.itemsize)
        return {"state": self._states().view(np.uint8), "streams": streams, "begun": np.array([self._begun])}

    def set_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Resume from the result of :meth:`get_state` of an environment with the same arguments, on any device.

        A ValueError if the state is of an environment of another size or version, or has values that no environment can
        reach; nothing changes.
        """
        check_forms(state, self.get_state())
        states = np.ascontiguousarray(state["state"]).view(self._states().dtype)
        self.worlds.write_states(states)
        self.worlds.write_streams(np.ascontiguousarray(state["streams"]).view(STREAM)[:, 0])
        self._begun = bool(state["begun"][0])
