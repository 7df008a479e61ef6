"""Animated GIFs of several episodes side by side, for places that show images only."""

from __future__ import annotations

import io
import math
from itertools import islice
from typing import TYPE_CHECKING, Any

import imageio
import numpy as np
from PIL import Image

from algorithms.reporting.video_grid import scaled, sheets
from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from algorithms.reporting.video_grid import Track
    from algorithms.reporting.videos import Frame

COLOURS = 255  # of the palette; one further index marks pixels that do not change


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

    Raises:
        ValueError: if there is no clip, one has no frames, or ``fps`` does not divide 100.
        OSError: if the file cannot be written.
    """
    if fps < 1 or 100 % fps:
        raise ValueError(f"fps = {fps} must divide 100, because a GIF counts hundredths of a second")

    def tile(frame: Frame) -> Frame:
        return scaled(frame[:, : len(frame)], side, side)

    shown = [sheet.copy() for sheet in sheets(clips, tile, len(clips), (255, 255, 255))]
    content = _encode(shown, 1000 // fps)
    atomic_write(path, content)
    return len(shown), len(content)


def _encode(frames: Sequence[Frame], milliseconds: float) -> bytes:
    """A looping GIF of frames of one size, each shown for so long."""
    samples = np.vstack(frames[:: max(1, len(frames) // 8)])
    palette = Image.fromarray(samples).quantize(COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=1)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    buffer = io.BytesIO()
    images[0].save(buffer, format="GIF", save_all=True, append_images=images[1:], duration=milliseconds, loop=0)
    return buffer.getvalue()


def video_as_gif(path: str | Path, *, max_width: int = 480, max_frames: int = 150) -> tuple[bytes, int, int]:
    """A video file as a looping GIF of the same length.

    Args:
        path: the file.
        max_width: pixels; a wider video is scaled down.
        max_frames: of a longer video as many are taken at equal distances.

    Returns:
        The GIF, its height and its width.

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
        frames = [
            np.asarray(Image.fromarray(frame).resize((width, height))) for frame in islice(reader, 0, None, stride)
        ]
    return _encode(frames, 1000 * stride / about["fps"]), height, width
