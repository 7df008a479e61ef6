"""A video of several policies side by side."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from algorithms.reporting.learning_curves import STYLE
from algorithms.reporting.videos import HOLD, writing

Picture = NDArray[np.uint8]  # (height, width, 3), RGB

MAX_WIDTH = 1600  # pixels of the whole; what is wider is scaled down
CAPTION_PIXELS = 36  # height of the strip above a tile
GAP = 4  # pixels between tiles that are side by side
BACKGROUND, INK = "#181C24", "#F0F3F8"  # of captions: as the panel of readings beside a map
DPI = 100
FONT_SIZES = np.arange(13.0, 6.5, -0.5)  # of captions, the first that fits


def write_mosaic(
    tracks: Sequence[tuple[str, Iterable[Picture]]], path: str | Path, fps: int, *, hold: float = HOLD
) -> int:
    """Write an MP4 of all ``tracks`` at once, each below its caption; the file appears when it is whole.

    Up to three lie side by side, four in a square, more as close to one as can be. A track that is over keeps its last
    frame until all are.

    Args:
        tracks: captions, and frames (height, width, 3) of uint8, all of one size.
        path: the file.
        fps: frames per second.
        hold: s for which the last picture stands.

    Returns:
        The number of frames.

    Raises:
        ValueError: if there is no track, one has no frames, or a frame has another size than the first.
        OSError: if the file cannot be written.
    """
    if not tracks:
        raise ValueError("tracks is empty; a mosaic needs at least one")
    if fps < 1 or hold < 0.0:
        raise ValueError(f"fps = {fps} must be at least 1, and hold = {hold} s not negative")
    captions, sources = [caption for caption, _ in tracks], [iter(frames) for _, frames in tracks]
    starts = []
    for caption, frames in zip(captions, sources, strict=True):
        first = next(frames, None)
        if first is None:
            raise ValueError(f"track {caption!r} has no frames")
        starts.append(first)
    _check(captions[0], starts[0], starts[0])
    sheet = Sheet(captions, starts[0].shape[0], starts[0].shape[1])
    count = 0
    with writing(path, fps) as write:
        running = [chain([first], frames) for first, frames in zip(starts, sources, strict=True)]
        while True:
            new = [next(frames, None) for frames in running]
            if all(frame is None for frame in new):
                break
            for k, frame in enumerate(new):
                if frame is not None:
                    _check(captions[k], frame, starts[0])
                    sheet.show(k, frame)
            write(sheet.picture)
            count += 1
        for _ in range(round(hold * fps)):
            write(sheet.picture)
            count += 1
    return count


def _check(caption: str, frame: Picture, like: Picture) -> None:
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or not frame.size:
        raise ValueError(
            f"a frame of track {caption!r} has shape {frame.shape} and dtype {frame.dtype}; "
            "it must be (height, width, 3) of uint8"
        )
    if frame.shape != like.shape:
        raise ValueError(f"a frame of track {caption!r} has shape {frame.shape}; the first track's have {like.shape}")


class Sheet:
    """A picture of tiles below captions.

    Args:
        captions: one per tile.
        height, width: pixels of the frames to be shown.

    Attributes:
        picture: the whole, with even sides; :meth:`show` changes it.
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
        self.picture: Picture = np.full(whole, [round(255 * part) for part in to_rgb(BACKGROUND)], dtype=np.uint8)
        for k, caption in enumerate(captions):
            top, left = self._corner(k)
            strip = caption_strip(caption, tile_width)
            self.picture[top - CAPTION_PIXELS : top, left : left + tile_width] = strip

    def _corner(self, k: int) -> tuple[int, int]:
        """Upper and left end of the tile ``k``."""
        row, column = divmod(k, self._columns)
        height, width = self._even
        return row * (CAPTION_PIXELS + height) + CAPTION_PIXELS, column * (width + GAP)

    def show(self, k: int, frame: Picture) -> None:
        """Put ``frame`` (height, width, 3) into the tile ``k``."""
        top, left = self._corner(k)
        height, width = self._even
        if self._scaled:
            tile = scaled(frame, height, width)
        else:
            tile = np.pad(frame, ((0, height - len(frame)), (0, width - frame.shape[1]), (0, 0)), mode="edge")
        self.picture[top : top + height, left : left + width] = tile


def scaled(frame: Picture, height: int, width: int) -> Picture:
    """``frame`` (h, w, 3) made smaller; every pixel is a mean of all that it stands for."""
    planes = torch.from_numpy(np.array(frame, order="C")).permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(planes, (height, width), mode="bilinear", antialias=True)
    return small[0].permute(1, 2, 0).numpy()


def caption_strip(text: str, width: int) -> Picture:
    """``text`` in one line on a strip (CAPTION_PIXELS, ``width``, 3); its end is left out where there is no room."""
    line = " ".join(text.split())
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width / DPI, CAPTION_PIXELS / DPI), dpi=DPI, facecolor=BACKGROUND)
        canvas = FigureCanvasAgg(figure)
        words = figure.text(10 / width, 0.5, line, color=INK, va="center_baseline", parse_math=False)

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
