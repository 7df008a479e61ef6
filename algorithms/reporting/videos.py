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
from PIL import Image, ImageDraw, ImageFont

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
FONT_SIZES = range(18, 9, -1)  # pixels, of captions; the first one that fits
BACKGROUND, INK = "#181C24", "#F0F3F8"  # of captions, which look like the panel of readings beside a map
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
    """Write an MP4 of a few episodes, one after the other, up to MAX_FRAMES; returns the number of frames."""
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
        problem = f"metadata['render_modes'] = {modes} lacks 'rgb_array'"
        raise ValueError(f"environment {env_id!r} cannot be rendered: {problem}")


def episode_frames(policy: Policy, env: VectorEnv, seed: int, *, greedy: bool) -> Iterator[Frame]:
    """The frames (height, width, 3) of one episode in an environment of :func:`make_render_env`, with even sides."""
    adapter = EnvAdapter(env, keep_ended=True)
    generator = None if greedy else torch.Generator(policy.device).manual_seed(seed)
    observations = adapter.reset(seed)
    yield rendered(env)
    for _ in drive(policy, adapter, observations, generator):
        yield rendered(env)


def rendered(env: VectorEnv) -> Frame:
    """The frame of the first environment; a ValueError if there is none."""
    frames = env.render()
    if not frames or not isinstance(frames[0], np.ndarray):
        raise ValueError("the environment rendered no frame")
    return frames[0]


def _held(frames: Iterable[Frame], seconds: float, fps: int) -> Iterator[Frame]:
    """The frames, the last of which is repeated for a moment."""
    last: list[Frame] = []
    for frame in frames:
        yield frame
        last = [frame]
    yield from last * round(seconds * fps)


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
    from matplotlib import get_data_path  # which has a font with all the letters of units

    line, room = " ".join(text.split()), width - 20
    fonts = [ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", size) for size in FONT_SIZES]
    font = next((font for font in fonts if font.getlength(line) <= room), fonts[-1])
    if font.getlength(line) > room:
        shorter = (f"{line[:end]}…" for end in range(len(line), 0, -1))
        line = next((text for text in shorter if font.getlength(text) <= room), "")
    strip = Image.new("RGB", (width, CAPTION_PIXELS), BACKGROUND)
    ImageDraw.Draw(strip).text((10, CAPTION_PIXELS / 2), line, INK, font, anchor="lm")
    return np.asarray(strip)


# ------------------------------------------------------------------------------------------------------------ MP4


@contextmanager
def video_writer(path: str | Path, fps: int) -> Iterator[Callable[[Frame], None]]:
    """A function that appends a frame to an MP4; the file appears when it is complete, unless empty."""
    path = without_links(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.tmp")  # as atomic_io names its own, if the process is killed
    count, encoder = 0, None
    # The temporary name does not tell the format; encoders need even sides.
    options = {"output_params": ["-f", "mp4", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"], "ffmpeg_log_level": "quiet"}

    def write(frame: Frame) -> None:
        nonlocal count, encoder
        if encoder is None:
            size = frame.shape[1], frame.shape[0]
            encoder = imageio_ffmpeg.write_frames(str(part), size, fps=fps, macro_block_size=1, quality=7, **options)
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
            try:  # ffmpeg's errors at the end of a video are not reported otherwise
                written, _ = imageio_ffmpeg.count_frames_and_secs(part)
            except RuntimeError:  # with all that ffmpeg has to say
                written = 0
            if written != count:
                raise OSError(f"{str(path)!r}: ffmpeg could write {written:,} of {count:,} frames; is the disk full?")
            part.replace(path)
    finally:
        if encoder is not None:
            encoder.close()
        part.unlink(missing_ok=True)


def _write_video(frames: Iterable[Frame], path: str | Path, fps: int) -> int:
    """Write an MP4, or a GIF; returns the number of frames."""
    if str(path).lower().endswith(".gif"):
        if fps < 1 or 100 % fps:
            raise ValueError(f"fps = {fps} must divide 100, because a GIF counts hundredths of a second")
        shown = list(frames)
        atomic_write(path, _encode_gif(shown, 1000 // fps))
        return len(shown)
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
    """Write an MP4, or a looping GIF, of all ``tracks`` at once, each below its caption.

    Up to three tracks, and all of a GIF, are side by side, more in a grid that is as square as possible. The last frame
    is shown for ``hold`` seconds. The file appears when it is complete. Returns the number of frames.
    """
    gif = str(path).lower().endswith(".gif")
    columns = len(tracks) if gif or len(tracks) <= 3 else math.ceil(math.sqrt(len(tracks)))
    return _write_video(_held(_sheets(tracks, columns, "white" if gif else BACKGROUND), hold, fps), path, fps)


def _sheets(tracks: Sequence[Track], columns: int, background: str) -> Iterator[Frame]:
    """The frames of all ``tracks`` at once, each below its caption; one that ends early keeps its last frame."""
    if not tracks:
        raise ValueError("there is no track; at least one is needed")
    sources = [iter(frames) for _, frames in tracks]
    shown = [next(frames, None) for frames in sources]
    height = width = 0
    for (caption, _), first in zip(tracks, shown, strict=True):
        if first is None:
            raise ValueError(f"track {caption!r} has no frames")
        height, width = first.shape[:2]
    scale = min(1.0, (MAX_WIDTH - GAP * (columns - 1)) / columns / width)
    height, width = int(scale * height), int(scale * width)
    rows = -(-len(tracks) // columns)
    sheet = Image.new("RGB", (columns * (width + GAP) - GAP, rows * (height + CAPTION_PIXELS)), background)
    places = [(k % columns * (width + GAP), k // columns * (height + CAPTION_PIXELS)) for k in range(len(tracks))]
    for (caption, _), place in zip(tracks, places, strict=True):
        sheet.paste(Image.fromarray(caption_strip(caption, width)), place)
    while any(frame is not None for frame in shown):
        for frame, (left, top) in zip(shown, places, strict=True):
            if frame is not None:
                sheet.paste(Image.fromarray(resized(frame, width, height)), (left, top + CAPTION_PIXELS))
        yield np.array(sheet)
        shown = [next(frames, None) for frames in sources]


def resized(frame: Frame, width: int, height: int) -> Frame:
    """``frame`` (h, w, 3) with another size, antialiased."""
    if frame.shape[:2] == (height, width):
        return frame
    return np.asarray(Image.fromarray(frame).resize((width, height), Image.Resampling.BILINEAR))


# ------------------------------------------------------------------------------------------------------------ GIF


def video_as_gif(path: str | Path, *, max_width: int = 480, max_frames: int = 150) -> tuple[bytes, int, int]:
    """A video file as a looping GIF of the same length, of ``max_frames`` at equal distances, its height and its width.

    A video that cannot be read is an OSError.
    """
    reader: Any = imageio.get_reader(path, format="FFMPEG")
    with reader:
        about = reader.get_meta_data()
        stride = max(1, math.ceil(about["duration"] * about["fps"] / max_frames))
        width, height = about["size"]
        scale = min(1.0, max_width / width)
        width, height = round(scale * width), round(scale * height)
        frames = [resized(frame, width, height) for frame in itertools.islice(reader, 0, None, stride)]
    return _encode_gif(frames, 1000 * stride / about["fps"]), height, width


def _encode_gif(frames: Sequence[Frame], milliseconds: float) -> bytes:
    """A looping GIF of frames of one size, each shown for so long."""
    samples = np.vstack(frames[:: max(1, len(frames) // 8)])
    palette = Image.fromarray(samples).quantize(GIF_COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=1)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    buffer = io.BytesIO()
    images[0].save(buffer, format="GIF", save_all=True, append_images=images[1:], duration=milliseconds, loop=0)
    return buffer.getvalue()
