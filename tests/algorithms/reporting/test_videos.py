"""Videos of a policy: what the frames show, of one vehicle and of two that end at different times."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from algorithms.actor_critic import ActorCritic
from algorithms.reporting import videos
from algorithms.reporting.videos import (
    HOLD,
    check_renderable,
    make_render_env,
    record,
    video_writer,
)
from algorithms.runs.agent_report import film
from algorithms.runs.build import build
from algorithms.runs.config import Experiment, make_experiment
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.support.atomic_io import leftovers
from mo_deepdrive.world.actions import action_names

ONE, TWO = "mo-deepdrive-one-waypoint-v0", "mo-deepdrive-intersection-v0"
UTILITIES = {ONE: "one_waypoint_linear", TWO: "intersection_linear"}
FPS, LIMIT = 10, 12
IDLE, SPEED_UP = (action_names("discrete").index(name) for name in ("idle", "decay steer, increase speed"))
GREEN, AMBER = (38, 150, 92), (170, 122, 34)
LABEL_ROWS = (84, 406)  # of the frame, where the panel says why each of two vehicles ended
LABEL_COLUMN = 720 + 310  # within a label, behind its text


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


def policy(*actions: int) -> Callable[..., NDArray[np.int64]]:
    """Always the same action per vehicle."""
    return lambda *_: np.array([actions])


def label(frame: NDArray[np.uint8], v: int) -> NDArray[np.uint8]:
    return frame[LABEL_ROWS[v], LABEL_COLUMN]


def resembles(pixel: NDArray[np.uint8], colour: tuple[int, ...]) -> bool:
    return bool(np.abs(pixel.astype(int) - colour).max() < 40)


@dataclass(frozen=True)
class Filmed:
    """An episode in which vehicle 0 waits until the time limit and vehicle 1 arrives before."""

    agent: ActorCritic
    count: int
    frames: NDArray[np.uint8]
    accrued: NDArray[np.float32]  # (decisions, V, d), as the policy saw them
    discounts: NDArray[np.float32]  # (decisions, V)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    agent, experiment = make(TWO, time_limit=LIMIT)
    seen: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []

    def act(observations: Any, accrued_reward: AccruedReward, generator: Any) -> NDArray[np.int64]:
        seen.append((accrued_reward.value[0].copy(), accrued_reward.discounts[0].copy()))
        return np.array([[IDLE, SPEED_UP]])

    path = tmp_path_factory.mktemp("video") / "episode.mp4"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(agent, "act", act)
        count = record(agent, experiment.environment.id, experiment.environment.arguments, path, episodes=1)
    accrued, discounts = (np.stack(each) for each in zip(*seen, strict=True))
    return Filmed(agent, count, iio.imread(path), accrued, discounts)


@pytest.mark.slow
def test_a_video_lasts_until_both_vehicles_have_ended(filmed: Filmed) -> None:
    assert len(filmed.frames) == filmed.count == 1 + LIMIT * FPS + round(HOLD * FPS)
    arrived = [resembles(label(frame, 1), GREEN) for frame in filmed.frames]
    first = arrived.index(True)
    assert 5 * FPS < first < LIMIT * FPS
    assert all(arrived[first:])
    late = [resembles(label(frame, 0), AMBER) for frame in filmed.frames]
    assert late.index(True) == LIMIT * FPS


@pytest.mark.slow
def test_the_policy_observes_the_rewards_of_its_vehicle(filmed: Filmed) -> None:
    gamma = filmed.agent.config.gamma
    powers = gamma ** np.arange(LIMIT * FPS)
    np.testing.assert_allclose(filmed.discounts, np.stack([powers, powers], axis=1), rtol=1e-4)
    assert not filmed.accrued[0].any()
    destinations = filmed.accrued[:, 1, filmed.agent.env.objectives.index("destination")]
    arrival = np.flatnonzero(destinations)[0]
    assert destinations[arrival] == pytest.approx(powers[arrival - 1], rel=1e-4)
    assert (filmed.accrued[arrival:, 1] == filmed.accrued[arrival, 1]).all(), "who has ended earns nothing more"


@pytest.mark.slow
def test_each_episode_of_one_vehicle_is_filmed_from_its_start_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, experiment = make(ONE, time_limit=1)
    monkeypatch.setattr(agent, "act", policy(SPEED_UP))
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


def test_a_video_that_fails_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    agent, experiment = make(ONE, time_limit=1)

    def act(*_: Any) -> NDArray[np.int64]:
        raise RuntimeError("no idea")

    monkeypatch.setattr(agent, "act", act)
    with pytest.raises(RuntimeError, match="no idea"):
        record(agent, experiment.environment.id, experiment.environment.arguments, tmp_path / "episode.mp4")
    assert not list(tmp_path.iterdir())


def test_a_video_without_frames_is_not_written(tmp_path: Path) -> None:
    with video_writer(tmp_path / "episode.mp4", FPS):
        pass
    assert not list(tmp_path.iterdir())


def test_an_environment_without_render_modes_cannot_be_rendered(
    examples: None, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    experiment = make_experiment(
        {
            "environment": {"id": "commute:commute-v0"},
            "utility": {"name": "linear", "arguments": {"weights": [1.0, 1.0]}},
            "algorithm": {"name": "mo_a2c", "steps": 4, "hidden": [8]},
            "training": {"total_timesteps": 8, "num_envs": 1},
        }
    )
    message = (
        r"environment 'commute:commute-v0' cannot be rendered: metadata\['render_modes'\] = \[\] lacks 'rgb_array'"
    )
    with pytest.raises(ValueError, match=message):
        make_render_env("commute:commute-v0")
    check_renderable("mo-mountaincar-v0")
    check_renderable(ONE)
    console = Console(width=200, record=True)
    assert not film(build(experiment), experiment, tmp_path / "video.mp4", console, seed=0)
    assert console.export_text().startswith("warning: no video: environment 'commute:commute-v0' cannot be rendered: ")
    assert not [warning for warning in recwarn if "render" in str(warning.message)]
    assert not list(tmp_path.iterdir())


def write_noise(path: Path, frames: int) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    with video_writer(path, fps=10) as write:
        for shift in range(frames):
            write(np.roll(noise, 7 * shift, axis=1))


@pytest.mark.skipif(os.name != "posix", reason="needs limits of file sizes")
@pytest.mark.parametrize("frames", [5, 60], ids=["at its end", "before its end"])
def test_a_video_that_could_not_be_written_whole_leaves_the_former_one(tmp_path: Path, frames: int) -> None:
    import resource

    path = tmp_path / "video.mp4"
    path.write_bytes(b"former")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(OSError, match=r"^'.*video.mp4': ffmpeg [^\n]*$"):
            write_noise(path, frames)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == b"former"
    assert [each.name for each in tmp_path.iterdir()] == ["video.mp4"]


def test_what_a_killed_process_leaves_of_a_video_is_found_when_its_run_is_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Path] = []
    monkeypatch.setattr(videos, "_check_whole", lambda *_: seen.extend(leftovers(tmp_path)))
    write_noise(tmp_path / "video.mp4", 1)
    assert len(seen) == 1
    assert list(tmp_path.iterdir()) == [tmp_path / "video.mp4"]
