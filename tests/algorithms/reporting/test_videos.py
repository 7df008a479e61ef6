"""Videos of policies: how long they are, of one and of several side by side, and what is left of one that fails."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from algorithms.actor_critic import ActorCritic
from algorithms.reporting.videos import (
    CAPTION_PIXELS,
    GAP,
    HOLD,
    Frame,
    caption_strip,
    cut_off,
    record,
    write_video_grid,
)
from algorithms.runs.build import build
from algorithms.runs.config import Experiment, make_experiment
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.world.actions import action_names

ONE, TWO = "mo-deepdrive-one-waypoint-v0", "mo-deepdrive-intersection-v0"
UTILITIES = {ONE: "one_waypoint_linear", TWO: "intersection_linear"}
FPS, LIMIT = 10, 12
IDLE, SPEED_UP = (action_names("discrete").index(name) for name in ("idle", "decay steer, increase speed"))


def make(env_id: str, **arguments: Any) -> tuple[ActorCritic, Experiment]:
    experiment = make_experiment(
        {
            "environment": {"id": env_id, "arguments": arguments},
            "utility": {"name": UTILITIES[env_id]},
            "algorithm": {"name": "mo_a2c", "steps": 4, "hidden": [8]},
            "training": {"total_timesteps": 8, "num_envs": 1},
        }
    )
    return build(experiment), experiment


@pytest.mark.slow
def test_a_video_lasts_until_both_vehicles_have_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    agent, experiment = make(TWO, time_limit=LIMIT)
    seen: list[NDArray[np.float32]] = []

    def act(observations: Any, accrued_reward: AccruedReward, generator: Any) -> NDArray[np.int64]:
        seen.append(accrued_reward.value[0].copy())
        return np.array([[IDLE, SPEED_UP]])  # vehicle 0 waits until the time limit and vehicle 1 arrives before

    monkeypatch.setattr(agent, "act", act)
    path = tmp_path / "episode.mp4"
    count = record(agent, experiment.environment.id, experiment.environment.arguments, path, episodes=1)
    assert len(iio.imread(path)) == count == 1 + LIMIT * FPS + round(HOLD * FPS)
    destinations = np.stack(seen)[:, 1, agent.env.objectives.index("destination")]
    assert len(np.unique(destinations)) == 2, "the policy observes the reward of its vehicle, which ends with it"


@pytest.mark.slow
def test_each_episode_of_one_vehicle_is_filmed_from_its_start_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, experiment = make(ONE, time_limit=1)
    monkeypatch.setattr(agent, "act", lambda *_: np.array([[SPEED_UP]]))
    count = record(
        agent, experiment.environment.id, experiment.environment.arguments, tmp_path / "episode.mp4", episodes=2
    )
    frames = iio.imread(tmp_path / "episode.mp4").astype(int)
    length = 1 + FPS + round(HOLD * FPS)
    assert len(frames) == count == 2 * length
    for start in (0, length):
        last = frames[start + FPS]
        assert np.abs(last - frames[start]).max() > 100
        assert np.abs(last - frames[start + length - 1]).mean() < 1


@pytest.mark.skipif(os.name != "posix", reason="needs limits of file sizes")
@pytest.mark.parametrize("frames", [5, 60], ids=["at its end", "before its end"])
def test_a_video_that_could_not_be_written_whole_leaves_the_former_one(tmp_path: Path, frames: int) -> None:
    import resource

    path = tmp_path / "video.mp4"
    path.write_bytes(b"former")
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(OSError, match=r"^'.*video.mp4': ffmpeg [^\n]*$"):
            write_video_grid([("", [np.roll(noise, 7 * shift, axis=1) for shift in range(frames)])], path, 10)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == b"former"
    assert [each.name for each in tmp_path.iterdir()] == ["video.mp4"]


# -------------------------------------------------------------------------------------------------------- side by side

WHITE = np.full((60, 100, 3), 255, dtype=np.uint8)


def failing() -> Iterator[Frame]:
    yield WHITE
    raise RuntimeError("no idea")


@pytest.mark.parametrize(
    ("tracks", "error", "message"),
    [
        ([], ValueError, "at least one"),
        ([("a", [WHITE]), ("b", [])], ValueError, "track 'b' has no frames"),
        ([("a", failing())], RuntimeError, "no idea"),
    ],
)
def test_tracks_that_cannot_be_shown_leave_nothing_behind(
    tmp_path: Path, tracks: Any, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        write_video_grid(tracks, tmp_path / "video.mp4", FPS)
    assert not list(tmp_path.iterdir())


def test_a_video_that_is_cut_off_says_so_on_its_last_frame() -> None:
    frames = [np.full((60, 200, 3), 5 * i, dtype=np.uint8) for i in range(30)]
    for count in (30, 31):
        assert list(map(id, cut_off(frames, count, 10))) == list(map(id, frames))
    *before, last = cut_off(frames, 20, 10)
    np.testing.assert_array_equal(before, frames[:19])
    np.testing.assert_array_equal(last[:-CAPTION_PIXELS], frames[19][:-CAPTION_PIXELS])
    np.testing.assert_array_equal(last[-CAPTION_PIXELS:], caption_strip("cut off after 2 s", 200))
    assert not list(cut_off([], 3, 10))


# ---------------------------------------------------------------------------------------------------------------- GIF

RED, BLUE = (220, 20, 30), (30, 40, 200)


def clip(colour: tuple[int, int, int], count: int) -> list[Frame]:
    """Frames with a colour, in which a white bar moves."""
    frames = []
    for t in range(count):
        frame: Frame = np.full((60, 60, 3), colour, dtype=np.uint8)
        frame[10 * t : 10 * t + 10] = 255
        frames.append(frame)
    return frames


def test_clips_of_a_gif_are_side_by_side_below_their_captions_and_the_shorter_one_waits(tmp_path: Path) -> None:
    path = tmp_path / "two.gif"
    tracks = [("Red", clip(RED, 5)), ("Blue", clip(BLUE, 2))]
    assert write_video_grid(tracks, path, 10, hold=0.0) == 5
    shown: list[Frame] = []
    with Image.open(path) as image:
        assert image.info["loop"] == 0
        for k in range(image.n_frames):
            image.seek(k)
            shown += [np.asarray(image.convert("RGB"))] * round(image.info["duration"] / 100)
    assert len(shown) == 5
    assert shown[0].shape == (60 + CAPTION_PIXELS, 120 + GAP, 3)
    for t, frame in enumerate(shown):
        for x, colour, bar in ((10, RED, t), (60 + GAP + 10, BLUE, min(t, 1))):
            column = frame[CAPTION_PIXELS:, x].astype(int)
            assert np.abs(column[57] - colour).max() < 12  # no bar comes that far down
            assert (column[10 * bar + 5] > 200).all()
        assert (frame[:, 60 : 60 + GAP] > 240).all()
