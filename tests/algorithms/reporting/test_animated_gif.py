"""GIFs of several clips side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from algorithms.reporting.videos import CAPTION_PIXELS, GAP, Frame, write_gif

RED, BLUE = (220, 20, 30), (30, 40, 200)


def frames(colour: tuple[int, int, int], count: int) -> list[Frame]:
    """Frames with the colour in the left square, in which a white bar moves, and grey on the right."""
    clip = []
    for t in range(count):
        frame: Frame = np.full((60, 100, 3), 128, dtype=np.uint8)
        frame[:, :60] = colour
        frame[10 * t : 10 * t + 10, :60] = 255
        clip.append(frame)
    return clip


def pictures(path: Path) -> list[Frame]:
    with Image.open(path) as image:
        shown = []
        for k in range(image.n_frames):
            image.seek(k)
            shown += [np.asarray(image.convert("RGB"))] * round(image.info["duration"] / 100)
        return shown


def test_clips_are_side_by_side_below_their_captions_and_the_shorter_one_waits(tmp_path: Path) -> None:
    path = tmp_path / "two.gif"
    count, size = write_gif([("Red", frames(RED, 5)), ("Blue", frames(BLUE, 2))], path, fps=10, side=32)
    assert (count, size) == (5, path.stat().st_size)
    shown = pictures(path)
    assert len(shown) == 5
    assert shown[0].shape == (32 + CAPTION_PIXELS, 64 + GAP, 3)
    for t, frame in enumerate(shown):
        for x, colour, bar in ((10, RED, t), (32 + GAP + 10, BLUE, min(t, 1))):
            column = frame[CAPTION_PIXELS:, x].astype(int)
            assert np.abs(column[30] - colour).max() < 12  # no bar comes that far down
            assert (column[round(32 * (bar + 0.5) / 6)] > 200).all()
        assert (frame[:, 32 : 32 + GAP] > 240).all()


def test_a_gif_loops(tmp_path: Path) -> None:
    write_gif([("Red", frames(RED, 3))], tmp_path / "one.gif", side=32)
    with Image.open(tmp_path / "one.gif") as image:
        assert image.info["loop"] == 0


@pytest.mark.parametrize(
    ("clips", "fps", "message"),
    [
        ([], 10, "there is no track"),
        ([("Red", [])], 10, "track 'Red' has no frames"),
        ([("Red", frames(RED, 2))], 30, "fps = 30 must divide 100"),
        ([("Red", frames(RED, 2))], 0, "fps = 0 must divide 100"),
    ],
)
def test_what_makes_no_gif_is_refused_and_writes_nothing(
    clips: list[tuple[str, list[Frame]]], fps: int, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        write_gif(clips, tmp_path / "none.gif", fps=fps)
    assert not list(tmp_path.iterdir())
