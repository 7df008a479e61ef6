"""Captions of videos, and the note on a video that is cut off."""

from __future__ import annotations

import numpy as np

from algorithms.reporting import fronts, videos
from algorithms.reporting.videos import CAPTION_PIXELS, Frame, caption_strip, cut_off


def frames(count: int) -> list[Frame]:
    return [np.full((60, 200, 3), 5 * i, dtype=np.uint8) for i in range(count)]


def test_what_is_short_enough_is_shown_as_it_is() -> None:
    for count in (3, 4):
        for shown, frame in zip(cut_off(frames(3), count, 10), frames(3), strict=True):
            np.testing.assert_array_equal(shown, frame)
    assert not list(cut_off([], 3, 10))


def test_the_last_frame_says_that_the_rest_is_cut_off() -> None:
    *before, last = cut_off(frames(30), 20, 10)
    assert len(before) == 19
    for shown, frame in zip(before, frames(19), strict=True):
        np.testing.assert_array_equal(shown, frame)
    np.testing.assert_array_equal(last[:-CAPTION_PIXELS], frames(20)[-1][:-CAPTION_PIXELS])
    np.testing.assert_array_equal(last[-CAPTION_PIXELS:], caption_strip("cut off after 2 s", 200))


def test_whole_episodes_of_our_environments_fit_into_a_video() -> None:
    env = videos.make_render_env("mo-deepdrive-one-waypoint-v0")
    try:
        frames_of_episode = env.unwrapped.config.max_decisions + 1
    finally:
        env.close()
    assert frames_of_episode <= fronts.MAX_FRAMES
    assert 3 * (frames_of_episode + videos.HOLD * 10) <= videos.MAX_FRAMES
