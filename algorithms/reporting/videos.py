"""Videos of policies as MP4 and GIF: of one, or of several side by side below their captions."""

from __future__ import annotations

import io
import itertools
import math
import os
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import imageio
import imageio_ffmpeg
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageColor

from algorithms.reporting.style import VIDEO_BACKGROUND, VIDEO_DPI, VIDEO_INK, figure_style
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, is_drivable, make_env
from mo_deepdrive.evaluation.policy import drive
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.support.atomic_io import atomic_write, without_links

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from gymnasium.vector import VectorEnv

    from mo_deepdrive.evaluation.policy import Policy

Frame = NDArray[np.uint8]  # (height, width, 3), RGB
Track = tuple[str, "Iterable[Frame]"]  # a caption and frames of one size

MAX_FRAMES = 2000  # of a video, three of our longest episodes; the rest is cut off
HOLD = 0.5  # s for which the last frame of an episode is shown
DEFAULT_FPS = 10  # where the environment does not say
CAPTION_PIXELS = 36  # height of a caption
FONT_SIZES = np.arange(13.0, 6.5, -0.5)  # of captions; the first one that fits
GAP = 4  # pixels between tiles that are side by side
MAX_WIDTH = 1600  # pixels of a video of several; wider ones are scaled down
GIF_COLOURS = 255  # of the palette; one further index marks pixels that do not change

# ------------------------------------------------------------------------------------------------- frames of a policy


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
    """
    env = make_render_env(env_id, env_arguments)
    try:
        fps = int(env.unwrapped.metadata.get("render_fps") or DEFAULT_FPS)
        frames = (
            frame
            for number in range(seed, seed + episodes)
            for frame in _held(episode_frames(policy, env, number, greedy=greedy), HOLD, fps)
        )
        return _write_video(cut_off(frames, MAX_FRAMES, fps), path, fps)
    finally:
        env.close()


def make_render_env(env_id: str, env_arguments: Mapping[str, Any] | None = None) -> VectorEnv:
    """A vector environment with one environment that renders RGB arrays, also in the step in which it ends."""
    check_renderable(env_id, env_arguments)
    return make_env(env_id, 1, {**(env_arguments or {}), "render_mode": "rgb_array"}, keep_ended=True)


def check_renderable(env_id: str, env_arguments: Mapping[str, Any] | None = None) -> None:
    """Refuse an environment that does not declare the render mode "rgb_array"."""
    if is_drivable(env_id):
        return
    env = make_env(env_id, 1, dict(env_arguments or {}))
    modes = list(env.unwrapped.metadata.get("render_modes", []))
    env.close()
    if "rgb_array" not in modes:
        raise ValueError(
            f"environment {env_id!r} cannot be rendered: metadata['render_modes'] = {modes} lacks 'rgb_array'"
        )


def episode_frames(policy: Policy, env: VectorEnv, seed: int, *, greedy: bool) -> Iterator[Frame]:
    """The frames (height, width, 3) of one episode in an environment of :func:`make_render_env`, with even sides."""
    adapter = EnvAdapter(env, keep_ended=True)
    generator = None if greedy else torch.Generator(policy.device).manual_seed(seed)
    observations = adapter.reset(seed)
    yield _rendered(env)
    for _ in drive(policy, adapter, observations, generator):
        yield _rendered(env)


def _rendered(env: VectorEnv) -> Frame:
    """The frame that the environment renders, padded to even sides, which video encoders need."""
    frames = env.render()
    if not frames or not isinstance(frames[0], np.ndarray):
        raise ValueError("the environment rendered no frame")
    return _even(frames[0])


def _even(frame: Frame) -> Frame:
    height, width = frame.shape[:2]
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _held(frames: Iterable[Frame], seconds: float, fps: int) -> Iterator[Frame]:
    """The frames, the last of which is repeated for a moment."""
    frame: Frame | None = None
    for frame in frames:
        yield frame
    if frame is not None:
        yield from [frame] * round(seconds * fps)


def cut_off(frames: Iterable[Frame], count: int, fps: int) -> Iterator[Frame]:
    """The first ``count`` of ``frames``; if there are more, the last one says at its lower end that it is cut off."""
    following = itertools.pairwise(itertools.chain(frames, [None]))
    for number, (frame, after) in enumerate(following, 1):
        assert frame is not None
        if number == count and after is not None:
            height, cut = min(CAPTION_PIXELS, len(frame)), frame.copy()
            cut[-height:] = caption_strip(f"cut off after {count / fps:.4g} s", frame.shape[1])[:height]
            yield cut
            return
        yield frame


def caption_strip(text: str, width: int) -> Frame:
    """``text`` in one line on a strip (CAPTION_PIXELS, ``width``, 3), shortened if it is too long."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # not earlier: most videos go without Matplotlib
    from matplotlib.figure import Figure

    line = " ".join(text.split())
    with figure_style():
        size = (width / VIDEO_DPI, CAPTION_PIXELS / VIDEO_DPI)
        figure = Figure(figsize=size, dpi=VIDEO_DPI, facecolor=VIDEO_BACKGROUND)
        canvas: Any = FigureCanvasAgg(figure)
        words = figure.text(10 / width, 0.5, line, color=VIDEO_INK, va="center_baseline", parse_math=False)

        def fits() -> bool:
            return words.get_window_extent(canvas.get_renderer()).width <= width - 20

        for font_size in FONT_SIZES:
            words.set_fontsize(font_size)
            if fits():
                break
        while line and not fits():
            line = line[:-1].rstrip()
            words.set_text(f"{line}…")
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


# ------------------------------------------------------------------------------------------------------------ MP4


@contextmanager
def video_writer(path: str | Path, fps: int) -> Iterator[Callable[[Frame], None]]:
    """A function that appends a frame with even sides to an MP4; the file appears when it is complete, unless empty.

    A process that is killed leaves a file that is named as the temporary ones of :mod:`mo_deepdrive.support.atomic_io`.
    """
    path = without_links(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    count, encoder = 0, None

    def write(frame: Frame) -> None:
        nonlocal count, encoder
        if encoder is None:
            size = frame.shape[1], frame.shape[0]
            mp4 = ["-f", "mp4"]  # the temporary name does not tell
            encoder = imageio_ffmpeg.write_frames(
                str(part), size, fps=fps, macro_block_size=1, quality=7, ffmpeg_log_level="quiet", output_params=mp4
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
        written, _ = imageio_ffmpeg.count_frames_and_secs(part)
    except RuntimeError:  # with all that ffmpeg has to say
        written = 0
    if written != count:
        raise OSError(f"{str(path)!r}: ffmpeg could write {written:,} of {count:,} frames; is the disk full?")


def _write_video(frames: Iterable[Frame], path: str | Path, fps: int) -> int:
    """Write an MP4; returns the number of frames."""
    count = 0
    with video_writer(path, fps) as write:
        for frame in frames:
            write(frame)
            count += 1
    return count


def video_seconds(path: str | Path) -> float:
    """The length of an MP4 in seconds."""
    reader: Any = imageio.get_reader(path, format="FFMPEG")
    with reader:
        return float(reader.get_meta_data()["duration"])


def write_video_grid(tracks: Sequence[Track], path: str | Path, fps: int, *, hold: float = HOLD) -> int:
    """Write an MP4 of all ``tracks`` at once, each below its caption; the file appears when it is complete.

    Up to three tracks are side by side, more in a grid that is as square as possible. A track that ends early keeps its
    last frame.

    Args:
        tracks: captions, and frames (height, width, 3) of uint8, all of the same size.
        path: the file.
        fps: frames per second.
        hold: time for which the last frame is shown (s).

    Returns:
        The number of frames.
    """
    columns = len(tracks) if len(tracks) <= 3 else math.ceil(math.sqrt(len(tracks)))

    def tile(frame: Frame) -> Frame:
        height, width = frame.shape[:2]
        room = (MAX_WIDTH - GAP * (columns - 1)) / columns
        if width > room:
            return scaled(frame, max(2, int(height * room / width) // 2 * 2), max(2, int(room) // 2 * 2))
        return _even(frame)

    frames = _sheets(tracks, tile, columns, ImageColor.getrgb(VIDEO_BACKGROUND))
    return _write_video(_held(frames, hold, fps), path, fps)


def _sheets(
    tracks: Sequence[Track], tile: Callable[[Frame], Frame], columns: int, background: tuple[int, ...]
) -> Iterator[Frame]:
    """The frames of all ``tracks`` at once, each below its caption; the same array each time.

    ``tile`` is what is shown of a frame, of the same size for all; a track that ends early keeps its last frame.
    """
    if not tracks:
        raise ValueError("there is no track; at least one is needed")
    sources = [iter(frames) for _, frames in tracks]
    new: list[Frame | None] = []
    for (caption, _), frames in zip(tracks, sources, strict=True):
        first = next(frames, None)
        if first is None:
            raise ValueError(f"track {caption!r} has no frames")
        shown = tile(first)
        height, width = len(shown) + CAPTION_PIXELS, shown.shape[1]
        new.append(np.vstack([caption_strip(caption, width), shown]))
    rows = -(-len(tracks) // columns)
    sheet = np.full((rows * height, columns * (width + GAP) - GAP, 3), background, dtype=np.uint8)
    while any(tile_frame is not None for tile_frame in new):
        for k, tile_frame in enumerate(new):
            if tile_frame is not None:
                bottom, left = (k // columns + 1) * height, k % columns * (width + GAP)
                sheet[bottom - len(tile_frame) : bottom, left : left + width] = tile_frame
        yield sheet
        new = [None if (frame := next(frames, None)) is None else tile(frame) for frames in sources]


def scaled(frame: Frame, height: int, width: int) -> Frame:
    """``frame`` (h, w, 3) scaled down with antialiasing."""
    return np.asarray(Image.fromarray(frame).resize((width, height), Image.Resampling.BILINEAR))


# ------------------------------------------------------------------------------------------------------------ GIF


def write_gif(clips: Sequence[Track], path: str | Path, *, fps: int = 10, side: int = 320) -> tuple[int, int]:
    """Write a looping GIF that shows ``clips`` side by side, each below its caption.

    A clip that is shorter than the longest one keeps showing its last frame.

    Args:
        clips: captions, and frames (height, width, 3) of uint8. The left square of each frame is shown.
        path: the file; it appears when it is complete.
        fps: frames per second, a divisor of 100, because a GIF counts hundredths of a second.
        side: pixels of a clip's width and height.

    Returns:
        The number of frames and of bytes.
    """
    if fps < 1 or 100 % fps:
        raise ValueError(f"fps = {fps} must divide 100, because a GIF counts hundredths of a second")

    def tile(frame: Frame) -> Frame:
        return scaled(frame[:, : len(frame)], side, side)

    frames = [sheet.copy() for sheet in _sheets(clips, tile, len(clips), (255, 255, 255))]
    content = _encode_gif(frames, 1000 // fps)
    atomic_write(path, content)
    return len(frames), len(content)


def video_as_gif(path: str | Path, *, max_width: int = 480, max_frames: int = 150) -> tuple[bytes, int, int]:
    """A video file as a looping GIF of the same length, of which at most ``max_frames`` are taken at equal distances.

    Returns:
        The GIF, its height and its width, at most ``max_width`` pixels.

    Raises:
        OSError: if the video cannot be read.
    """
    reader: Any = imageio.get_reader(path, format="FFMPEG")
    with reader:
        about = reader.get_meta_data()
        stride = max(1, math.ceil(about["duration"] * about["fps"] / max_frames))
        width, height = about["size"]
        scale = min(1.0, max_width / width)
        width, height = round(scale * width), round(scale * height)
        shown = itertools.islice(reader, 0, None, stride)
        frames = [np.asarray(Image.fromarray(frame).resize((width, height))) for frame in shown]
    return _encode_gif(frames, 1000 * stride / about["fps"]), height, width


def _encode_gif(frames: Sequence[Frame], milliseconds: float) -> bytes:
    """A looping GIF of frames of one size, each shown for so long."""
    samples = np.vstack(frames[:: max(1, len(frames) // 8)])
    palette = Image.fromarray(samples).quantize(GIF_COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=1)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    buffer = io.BytesIO()
    images[0].save(buffer, format="GIF", save_all=True, append_images=images[1:], duration=milliseconds, loop=0)
    return buffer.getvalue()
