"""Frames of several policies side by side, and videos of them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageColor

from algorithms.reporting.style import VIDEO_BACKGROUND
from algorithms.reporting.videos import CAPTION_PIXELS, HOLD, Frame, caption_strip, video_writer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

Track = tuple[str, "Iterable[Frame]"]  # a caption and frames of one size

GAP = 4  # pixels between tiles that are side by side
MAX_WIDTH = 1600  # pixels of the video; wider ones are scaled down


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

    Raises:
        ValueError: if there is no track, or a track has no frames.
        OSError: if the file cannot be written.
    """
    n = len(tracks)
    columns = n if n <= 3 else math.ceil(math.sqrt(n))

    def tile(frame: Frame) -> Frame:
        height, width = frame.shape[:2]
        room = (MAX_WIDTH - GAP * (columns - 1)) / columns
        if width > room:
            return scaled(frame, max(2, int(height * room / width) // 2 * 2), max(2, int(room) // 2 * 2))
        return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")  # even, as encoders need

    count = 0
    with video_writer(path, fps) as write:
        sheet = None
        for sheet in sheets(tracks, tile, columns, ImageColor.getrgb(VIDEO_BACKGROUND)):
            write(sheet)
            count += 1
        for _ in range(round(hold * fps)):
            assert sheet is not None
            write(sheet)
            count += 1
    return count


def sheets(
    tracks: Sequence[Track], tile: Callable[[Frame], Frame], columns: int, background: tuple[int, ...]
) -> Iterator[Frame]:
    """The frames of all ``tracks`` at once, each below its caption; the same array each time.

    A track that ends early keeps its last frame.

    Args:
        tracks: captions, and frames (height, width, 3) of uint8.
        tile: what is shown of a frame, of the same size for all.
        columns: tiles in a row.
        background: red, green and blue of the gaps and of empty places.

    Raises:
        ValueError: if there is no track, or a track has no frames.
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
    while any(each is not None for each in new):
        for k, each in enumerate(new):
            if each is not None:
                bottom, left = (k // columns + 1) * height, k % columns * (width + GAP)
                sheet[bottom - len(each) : bottom, left : left + width] = each
        yield sheet
        new = [None if (frame := next(frames, None)) is None else tile(frame) for frames in sources]


def scaled(frame: Frame, height: int, width: int) -> Frame:
    """``frame`` (h, w, 3) scaled down with antialiasing."""
    return np.asarray(Image.fromarray(frame).resize((width, height), Image.Resampling.BILINEAR))
