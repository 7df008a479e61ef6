"""Videos of a policy."""

from __future__ import annotations

import itertools
import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import imageio
import imageio_ffmpeg
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv

from algorithms.reporting.captions import cut_off
from mo_deepdrive.envs.vector import DrivingVectorEnv
from mo_deepdrive.evaluation.accrued_reward import AccruedReward
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, find_spec, make_env
from mo_deepdrive.evaluation.splits import SPLITS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.policy import Policy

MAX_FRAMES = 2000  # of a video, three of our longest episodes; the rest is cut off
HOLD = 0.5  # s for which the last frame of an episode is shown
DEFAULT_FPS = 10  # where the environment does not say


def record(
    policy: Policy,
    env_id: str,
    env_arguments: Mapping[str, Any],
    path: str | Path,
    *,
    episodes: int = 3,
    seed: int = SPLITS["test"].start,
    greedy: bool = True,
) -> int:
    """Write an MP4 of a few episodes, one after the other; the file appears when it is complete.

    Args:
        policy: what acts.
        env_id: of the environment.
        env_arguments: keyword arguments of the environment.
        path: the file.
        episodes: number of episodes; if they exceed MAX_FRAMES, the rest is cut off, which the last frame says.
        seed: of the first episode.
        greedy: take the most likely (or mean) action instead of sampling.

    Returns:
        The number of frames.

    Raises:
        ValueError: if the environment cannot be rendered.
        OSError: if the file cannot be written.
    """
    env = make_render_env(env_id, env_arguments)
    try:
        fps = int(env.unwrapped.metadata.get("render_fps") or DEFAULT_FPS)
        with video_writer(path, fps) as write:
            count = 0
            for frame in cut_off(_episodes(policy, env, range(seed, seed + episodes), greedy, fps), MAX_FRAMES, fps):
                write(frame)
                count += 1
    finally:
        env.close()
    return count


@contextmanager
def video_writer(path: str | Path, fps: int) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """A function that appends a frame with even sides to an MP4; the file appears when it is complete, unless empty.

    A process that is killed leaves a file that is named as the temporary ones of :mod:`mo_deepdrive.atomic_io`.

    Args:
        path: the file.
        fps: frames per second.

    Raises:
        OSError: if the file cannot be written.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    count, encoder = 0, None

    def write(frame: NDArray[np.uint8]) -> None:
        nonlocal count, encoder
        if encoder is None:
            encoder = imageio_ffmpeg.write_frames(
                str(part),
                (frame.shape[1], frame.shape[0]),
                fps=fps,
                macro_block_size=1,
                quality=7,
                ffmpeg_log_level="quiet",
                output_params=["-f", "mp4"],  # the temporary name does not tell
            )
            encoder.send(None)
        try:
            encoder.send(np.ascontiguousarray(frame))
        except OSError as error:  # with ffmpeg's whole command line
            raise OSError(f"{str(path)!r}: ffmpeg ended early: {str(error).splitlines()[0]}") from None
        count += 1

    try:
        yield write
        if encoder is not None:
            encoder.close()
            _check_whole(part, path, count)
            part.replace(path)
    finally:
        if encoder is not None:
            encoder.close()
        part.unlink(missing_ok=True)


def _check_whole(part: Path, path: Path, count: int) -> None:
    """Refuse a video that lacks frames: ffmpeg's errors at its end are not reported otherwise."""
    try:
        found, _ = imageio_ffmpeg.count_frames_and_secs(part)
    except RuntimeError:  # with all that ffmpeg has to say
        found = 0
    if found != count:
        raise OSError(f"{str(path)!r}: ffmpeg could write {found:,} of {count:,} frames; is the disk full?")


def video_seconds(path: str | Path) -> float:
    """The length of an MP4 in seconds.

    Raises:
        OSError: if it cannot be read.
    """
    reader: Any = imageio.get_reader(path, format="FFMPEG")
    with reader:
        return float(reader.get_meta_data()["duration"])


def make_render_env(env_id: str, env_arguments: Mapping[str, Any] | None = None) -> VectorEnv:
    """A vector environment with one environment that renders RGB arrays and, if it is ours, does not reset itself.

    Args:
        env_id: a registered id, or ``module:id`` to import the module that registers it first.
        env_arguments: keyword arguments of the environment.

    Raises:
        ValueError: if the environment cannot be rendered.
    """
    arguments = {**(env_arguments or {}), "render_mode": "rgb_array"}
    if _is_ours(env_id):
        return gymnasium.make_vec(env_id, num_envs=1, autoreset_mode=AutoresetMode.DISABLED, **arguments)
    check_renderable(env_id, env_arguments)
    return make_env(env_id, 1, arguments)


def check_renderable(env_id: str, env_arguments: Mapping[str, Any] | None = None) -> None:
    """Refuse an environment that does not declare the render mode "rgb_array"; arguments as :func:`make_render_env`.

    Raises:
        ValueError: with the render modes that it has.
    """
    if _is_ours(env_id):
        return
    env = make_env(env_id, 1, dict(env_arguments or {}))
    modes = list(env.unwrapped.metadata.get("render_modes", []))
    env.close()
    if "rgb_array" not in modes:
        raise ValueError(
            f"environment {env_id!r} cannot be rendered: metadata['render_modes'] = {modes} lacks 'rgb_array'"
        )


def _is_ours(env_id: str) -> bool:
    return str(find_spec(env_id).vector_entry_point).startswith("mo_deepdrive.")


def _episodes(
    policy: Policy, env: VectorEnv, seeds: Iterable[int], greedy: bool, fps: int
) -> Iterator[NDArray[np.uint8]]:
    """The frames of one episode per seed; the last frame of each is repeated for a moment."""
    for seed in seeds:
        frame: NDArray[np.uint8]
        for frame in episode_frames(policy, env, seed, greedy=greedy):
            yield frame
        yield from [frame] * round(HOLD * fps)


def episode_frames(policy: Policy, env: VectorEnv, seed: int, *, greedy: bool) -> Iterator[NDArray[np.uint8]]:
    """The frames (height, width, 3) of one episode, with even sides.

    Args:
        policy: what acts.
        env: from :func:`make_render_env`.
        seed: of the episode.
        greedy: take the most likely (or mean) action instead of sampling.
    """
    trained_on = policy.env
    vehicles, d = trained_on.vehicles, len(trained_on.objectives)
    generator = None if greedy else torch.Generator(policy.device).manual_seed(seed)
    # Ours is stepped without an adapter, which would have to reset it at the end of the episode.
    adapter = None if isinstance(env.unwrapped, DrivingVectorEnv) else EnvAdapter(env)
    accrued_reward = AccruedReward.begin(1, vehicles, d)
    running = np.ones((1, vehicles), dtype=np.bool_)
    observations = env.reset(seed=seed)[0].reshape(1, vehicles, -1) if adapter is None else adapter.reset(seed)
    yield _frame(env)
    for _ in itertools.count() if adapter is None else adapter.decisions():
        actions = policy.act(observations, accrued_reward, generator)
        if adapter is None:
            raw, rewards, *flags, _ = env.step(trained_on.environment_actions(actions))
            observations, rewards = raw.reshape(1, vehicles, -1), rewards.reshape(1, vehicles, d)
            over = (flags[0] | flags[1]).reshape(1, vehicles)
        else:
            step = adapter.step(actions)
            observations, rewards, over = step.observations, step.rewards, step.terminated | step.truncated
        accrued_reward.add(rewards, policy.gamma)
        running &= ~over
        yield _frame(env)
        if not running.any():
            break


def _frame(env: VectorEnv) -> NDArray[np.uint8]:
    """The frame that the environment renders, padded to even sides, which video encoders need."""
    frames = env.render()
    if not frames or not isinstance(frames[0], np.ndarray):
        raise ValueError("the environment rendered no frame")
    height, width = frames[0].shape[:2]
    return np.pad(frames[0], ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
