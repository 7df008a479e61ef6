"""Text in videos: the caption above an episode, and the note on the last frame of one that is cut off."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from algorithms.reporting.style import VIDEO_BACKGROUND, VIDEO_DPI, VIDEO_INK, figure_style

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

Frame = NDArray[np.uint8]  # (height, width, 3), RGB

CAPTION_PIXELS = 36  # height of a caption
FONT_SIZES = np.arange(13.0, 6.5, -0.5)  # of captions; the first one that fits


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
