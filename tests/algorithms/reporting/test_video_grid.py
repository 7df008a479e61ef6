"""Videos of several policies: where each is shown, for how long, and what is refused."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from numpy.typing import NDArray

from algorithms.reporting.videos import CAPTION_PIXELS, GAP, MAX_WIDTH, caption_strip, scaled, write_video_grid

Frame = NDArray[np.uint8]
FPS = 10
HEIGHT, WIDTH = 60, 100
COLOURS = ((200, 40, 40), (40, 180, 40), (50, 60, 220), (220, 200, 40))


def plain(level: float, colour: tuple[int, ...] = (255, 255, 255), size: tuple[int, int] = (HEIGHT, WIDTH)) -> Frame:
    """A frame of one colour, darkened to ``level``."""
    return np.full((*size, 3), np.array(colour) * level, dtype=np.uint8)


def tile(frames: Frame, row: int, column: int) -> Frame:
    """The tile at a place, of all frames, less a margin where colours run."""
    top = row * (HEIGHT + CAPTION_PIXELS) + CAPTION_PIXELS
    left = column * (WIDTH + GAP)
    return frames[:, top + 8 : top + HEIGHT - 8, left + 8 : left + WIDTH - 8]


def assert_near(pixels: Frame, colour: NDArray[np.float64], tolerance: float = 16.0) -> None:
    assert np.abs(pixels.astype(float) - colour).max() < tolerance


@pytest.mark.slow
def test_four_tracks_form_a_square_and_each_keeps_its_last_frame(tmp_path: Path) -> None:
    lengths = (3, 8, 5, 1)

    def track(k: int) -> Iterator[Frame]:
        for step in range(lengths[k]):
            yield plain(0.5 + step / 16, COLOURS[k])

    tracks = [(f"policy {k}", track(k)) for k in range(4)]
    count = write_video_grid(tracks, tmp_path / "video.mp4", FPS, hold=0.5)
    frames = iio.imread(tmp_path / "video.mp4")
    assert len(frames) == count == max(lengths) + 5
    assert frames.shape[1:] == (2 * (HEIGHT + CAPTION_PIXELS), 2 * WIDTH + GAP, 3)
    for k in range(4):
        for step in range(count):
            level = 0.5 + min(step, lengths[k] - 1) / 16
            assert_near(tile(frames, *divmod(k, 2))[step], np.array(COLOURS[k]) * level)
    assert list(tmp_path.iterdir()) == [tmp_path / "video.mp4"]


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2, 3])
def test_up_to_three_tracks_are_side_by_side(tmp_path: Path, n: int) -> None:
    count = write_video_grid(
        [("", [plain(1.0, COLOURS[k])] * 2) for k in range(n)], tmp_path / "video.mp4", FPS, hold=0.0
    )
    frames = iio.imread(tmp_path / "video.mp4")
    assert count == 2
    assert frames.shape == (2, HEIGHT + CAPTION_PIXELS, n * (WIDTH + GAP) - GAP, 3)
    for k in range(n):
        assert_near(tile(frames, 0, k), np.array(COLOURS[k]))


def test_the_rest_of_the_last_row_is_empty(tmp_path: Path) -> None:
    write_video_grid([(str(k), [plain(1.0)]) for k in range(5)], tmp_path / "video.mp4", FPS, hold=0.2)
    frames = iio.imread(tmp_path / "video.mp4")
    assert frames.shape[1:] == (2 * (HEIGHT + CAPTION_PIXELS), 3 * (WIDTH + GAP) - GAP, 3)
    assert tile(frames, 1, 1).min() > 230
    assert tile(frames, 1, 2).max() < 60


def test_captions_are_above_their_tiles(tmp_path: Path) -> None:
    write_video_grid([("", [plain(0.0)]), ("WWW", [plain(0.0)])], tmp_path / "video.mp4", FPS)
    strips = iio.imread(tmp_path / "video.mp4")[0, :CAPTION_PIXELS].max(axis=2)
    assert strips[:, :WIDTH].max() < 60
    assert strips[:, WIDTH + GAP :].max() > 180


def test_wide_frames_are_scaled_and_odd_sides_made_even(tmp_path: Path) -> None:
    height, width = 301, 1101
    frame = plain(1.0, size=(height, width))
    frame[:, width // 2 :] = 0
    write_video_grid([("a", [frame]), ("b", [frame])], tmp_path / "wide.mp4", FPS)
    frame = iio.imread(tmp_path / "wide.mp4")[0]
    assert frame.shape[1] in range(MAX_WIDTH - 4, MAX_WIDTH + 1)
    shown = (frame.shape[1] - GAP) // 2
    assert (frame.shape[0] - CAPTION_PIXELS) / shown == pytest.approx(height / width, abs=0.005)
    row = frame[CAPTION_PIXELS + 50].astype(int)
    for left in (0, shown + GAP):
        assert row[left + 5 : left + shown // 2 - 5].min() > 230
        assert row[left + shown // 2 + 5 : left + shown - 5].max() < 30
    write_video_grid([("a", [plain(1.0, size=(31, 57))])], tmp_path / "odd.mp4", FPS)
    frame = iio.imread(tmp_path / "odd.mp4")[0]
    assert frame.shape == (CAPTION_PIXELS + 32, 58, 3)
    assert frame[CAPTION_PIXELS + 8 :].min() > 230


def test_scaling_averages_pixels() -> None:
    fine = np.indices((40, 80)).sum(axis=0) % 2 * 255
    small = scaled(np.repeat(fine[..., None], 3, axis=2).astype(np.uint8), 10, 20)
    assert small.shape == (10, 20, 3)
    assert np.abs(small.astype(int) - 127).max() <= 2
    small = scaled(plain(0.5, COLOURS[0])[::-1], 20, 30)
    np.testing.assert_array_equal(small, plain(0.5, COLOURS[0], (20, 30)))


@pytest.mark.slow
def test_captions_that_do_not_fit_shrink_and_are_then_shortened() -> None:
    def ink(text: str, width: int = 300) -> tuple[int, int]:
        """Width and height of what is written."""
        strip = caption_strip(text, width).max(axis=2) > 90
        assert strip.shape == (CAPTION_PIXELS, width)
        columns, rows = np.flatnonzero(strip.any(axis=0)), np.flatnonzero(strip.any(axis=1))
        assert columns[-1] <= width - 10
        return int(np.ptp(columns)), int(np.ptp(rows))

    short, longer, endless = ink("H" * 10), ink("H" * 30), ink("H" * 300)
    assert short[1] > longer[1] >= endless[1], "smaller letters"
    assert longer[0] > short[0]
    assert endless[0] > 240
    assert ink("two\nlines  $x^2$")[1] < 24
    assert (caption_strip("", 300) == caption_strip("", 300)[0, 0]).all()


def test_invalid_tracks_are_refused_and_leave_nothing_behind(tmp_path: Path) -> None:
    path, fine = tmp_path / "video.mp4", [plain(1.0)]
    with pytest.raises(ValueError, match="at least one"):
        write_video_grid([], path, FPS)
    with pytest.raises(ValueError, match="track 'b' has no frames"):
        write_video_grid([("a", fine), ("b", iter(()))], path, FPS)
    assert not list(tmp_path.iterdir())


def test_a_track_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    def track() -> Iterator[Frame]:
        yield plain(1.0)
        raise RuntimeError("no idea")

    with pytest.raises(RuntimeError, match="no idea"):
        write_video_grid([("a", track())], tmp_path / "video.mp4", FPS)
    assert not list(tmp_path.iterdir())
