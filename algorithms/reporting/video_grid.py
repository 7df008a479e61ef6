"""Videos of several policies side by side."""

from __future__ import annotations

import math
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import ImageColor

from algorithms.reporting.captions import CAPTION_PIXELS, caption_strip
from algorithms.reporting.style import VIDEO_BACKGROUND
from algorithms.reporting.videos import HOLD, video_writer

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

Frame = NDArray[np.uint8]  # (height, width, 3), RGB

GAP = 4  # pixels between tiles that are side by side
MAX_WIDTH = 1600  # pixels of the video; wider ones are scaled down


def write_video_grid(
    tracks: Sequence[tuple[str, Iterable[Frame]]], path: str | Path, fps: int, *, hold: float = HOLD
) -> int:
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
        ValueError: if there is no track, a track has no frames, or a frame has another size than the first.
        OSError: if the file cannot be written.
    """
    if not tracks:
        raise ValueError("tracks is empty; a video grid needs at least one")
    if fps < 1 or hold < 0.0:
        raise ValueError(f"fps = {fps} must be at least 1, and hold = {hold} s must not be negative")
    captions, sources = [caption for caption, _ in tracks], [iter(frames) for _, frames in tracks]
    starts = []
    for caption, frames in zip(captions, sources, strict=True):
        first = next(frames, None)
        if first is None:
            raise ValueError(f"track {caption!r} has no frames")
        starts.append(first)
    _check(captions[0], starts[0], starts[0])
    grid = VideoGrid(captions, starts[0].shape[0], starts[0].shape[1])
    count = 0
    with video_writer(path, fps) as write:
        running = [chain([first], frames) for first, frames in zip(starts, sources, strict=True)]
        while True:
            new = [next(frames, None) for frames in running]
            if all(frame is None for frame in new):
                break
            for k, frame in enumerate(new):
                if frame is not None:
                    _check(captions[k], frame, starts[0])
                    grid.show(k, frame)
            write(grid.frame)
            count += 1
        for _ in range(round(hold * fps)):
            write(grid.frame)
            count += 1
    return count


def _check(caption: str, frame: Frame, like: Frame) -> None:
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or not frame.size:
        raise ValueError(
            f"a frame of track {caption!r} has shape {frame.shape} and dtype {frame.dtype}; "
            "it must be (height, width, 3) of uint8"
        )
    if frame.shape != like.shape:
        raise ValueError(f"a frame of track {caption!r} has shape {frame.shape}; the first track's have {like.shape}")


class VideoGrid:
    """A grid of tiles, each below its caption, drawn into one frame.

    Args:
        captions: one per tile.
        height: of the frames to be shown (pixels).
        width: of the frames to be shown (pixels).

    Attributes:
        frame: the whole grid, with even sides; :meth:`show` changes it.
    """

    def __init__(self, captions: Sequence[str], height: int, width: int):
        n = len(captions)
        self._columns = n if n <= 3 else math.ceil(math.sqrt(n))
        rows = -(-n // self._columns)
        room = (MAX_WIDTH - GAP * (self._columns - 1)) / self._columns
        scale = min(1.0, room / width)
        self._even = (height + height % 2, width + width % 2)
        if scale < 1.0:
            self._even = (max(2, int(height * scale) // 2 * 2), max(2, int(room) // 2 * 2))
        tile_height, tile_width = self._even
        self._scaled = scale < 1.0
        whole = (rows * (CAPTION_PIXELS + tile_height), self._columns * (tile_width + GAP) - GAP, 3)
        self.frame: Frame = np.full(whole, ImageColor.getrgb(VIDEO_BACKGROUND), dtype=np.uint8)
        for k, caption in enumerate(captions):
            top, left = self._corner(k)
            strip = caption_strip(caption, tile_width)
            self.frame[top - CAPTION_PIXELS : top, left : left + tile_width] = strip

    def _corner(self, k: int) -> tuple[int, int]:
        """Top and left end of tile ``k``."""
        row, column = divmod(k, self._columns)
        height, width = self._even
        return row * (CAPTION_PIXELS + height) + CAPTION_PIXELS, column * (width + GAP)

    def show(self, k: int, frame: Frame) -> None:
        """Put ``frame`` (height, width, 3) into tile ``k``."""
        top, left = self._corner(k)
        height, width = self._even
        if self._scaled:
            tile = scaled(frame, height, width)
        else:
            tile = np.pad(frame, ((0, height - len(frame)), (0, width - frame.shape[1]), (0, 0)), mode="edge")
        self.frame[top : top + height, left : left + width] = tile


def scaled(frame: Frame, height: int, width: int) -> Frame:
    """``frame`` (h, w, 3) scaled down with antialiasing."""
    planes = torch.from_numpy(np.array(frame, order="C")).permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(planes, (height, width), mode="bilinear", antialias=True)
    return small[0].permute(1, 2, 0).numpy()
