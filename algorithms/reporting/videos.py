"""Videos of a policy, and the text in videos: captions, and the note on the last frame of one that is cut off."""

from __future__ import annotations

import itertools
import os
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import gymnasium
import imageio
import imageio_ffmpeg
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from algorithms.reporting.style import VIDEO_BACKGROUND, VIDEO_DPI, VIDEO_INK, figure_style
from mo_deepdrive.envs.vector import DrivingVectorEnv
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, find_spec, make_env
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.support.atomic_io import without_links

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

    from mo_deepdrive.evaluation.policy import Policy

Frame = NDArray[np.uint8]  # (height, width, 3), RGB

MAX_FRAMES = 2000  # of a video, three of our longest episodes; the rest is cut off
HOLD = 0.5  # s for which the last frame of an episode is shown
DEFAULT_FPS = 10  # where the environment does not say
CAPTION_PIXELS = 36  # height of a caption
FONT_SIZES = np.arange(13.0, 6.5, -0.5)  # of captions; the first one that fits


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
def video_writer(path: str | Path, fps: int) -> Iterator[Callable[[Frame], None]]:
    """A function that appends a frame with even sides to an MP4; the file appears when it is complete, unless empty.

    A process that is killed leaves a file that is named as the temporary ones of :mod:`mo_deepdrive.support.atomic_io`.

    Args:
        path: the file.
        fps: frames per second.

    Raises:
        OSError: if the file cannot be written.
    """
    path = without_links(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    count, encoder = 0, None

    def write(frame: Frame) -> None:
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


def _episodes(policy: Policy, env: VectorEnv, seeds: Iterable[int], greedy: bool, fps: int) -> Iterator[Frame]:
    """The frames of one episode per seed; the last frame of each is repeated for a moment."""
    for seed in seeds:
        frame: Frame
        for frame in episode_frames(policy, env, seed, greedy=greedy):
            yield frame
        yield from [frame] * round(HOLD * fps)


def episode_frames(policy: Policy, env: VectorEnv, seed: int, *, greedy: bool) -> Iterator[Frame]:
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


def _frame(env: VectorEnv) -> Frame:
    """The frame that the environment renders, padded to even sides, which video encoders need."""
    frames = env.render()
    if not frames or not isinstance(frames[0], np.ndarray):
        raise ValueError("the environment rendered no frame")
    height, width = frames[0].shape[:2]
    return np.pad(frames[0], ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def cut_off(frames: Iterable[Frame], count: int, fps: int) -> Iterator[Frame]:
    """The first ``count`` of ``frames``; if there are more, the last one says at its lower end that it is cut off.

    Args:
        frames: (height, width, 3) of uint8.
        count: of frames at most.
        fps: frames per second.
    """
    last = None
    for i, frame in enumerate(frames):
        if i == count and last is not None:
            height = min(CAPTION_PIXELS, len(last))
            last = last.copy()
            last[-height:] = caption_strip(f"cut off after {count / fps:.4g} s", last.shape[1])[:height]
            break
        if last is not None:
            yield last
        last = frame
    if last is not None:
        yield last


def caption_strip(text: str, width: int) -> Frame:
    """``text`` in one line on a strip (CAPTION_PIXELS, ``width``, 3), shortened if it is too long."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # not earlier: most videos go without Matplotlib
    from matplotlib.figure import Figure

    line = " ".join(text.split())
    with figure_style():
        figure = Figure(
            figsize=(width / VIDEO_DPI, CAPTION_PIXELS / VIDEO_DPI), dpi=VIDEO_DPI, facecolor=VIDEO_BACKGROUND
        )
        canvas: Any = FigureCanvasAgg(figure)
        words = figure.text(10 / width, 0.5, line, color=VIDEO_INK, va="center_baseline", parse_math=False)

        def fits() -> bool:
            return words.get_window_extent(canvas.get_renderer()).width <= width - 20

        for size in FONT_SIZES:
            words.set_fontsize(size)
            if fits():
                break
        while line and not fits():
            line = line[:-1].rstrip()
            words.set_text(f"{line}…")
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
