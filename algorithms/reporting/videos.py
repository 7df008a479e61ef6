"""Videos of a policy."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import imageio
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from algorithms.common.accrued_reward import AccruedReward
from algorithms.common.env_adapter import EnvAdapter, make_env
from algorithms.experiments.config import EnvironmentSettings, find_environment, is_ours
from mo_deepdrive.envs.vector import DrivingVectorEnv

if TYPE_CHECKING:
    from algorithms.agent import Agent
    from algorithms.evaluation.evaluate import Policy

MAX_FRAMES = 750  # where the video is cut off
HOLD = 0.5  # s for which an episode's last frame stands


def record(
    agent: Agent,
    environment: EnvironmentSettings,
    path: str | Path,
    *,
    episodes: int = 3,
    seed: int = 1_000_000,
    greedy: bool = True,
) -> int:
    """Write an MP4 of a few episodes, one after the other; the file appears when it is whole.

    Args:
        agent: the policy.
        environment: where it acts.
        path: the file.
        episodes: how many; less where they are long.
        seed: of the first episode.
        greedy: argmax or mean action, instead of samples.

    Returns:
        The number of frames.

    Raises:
        ValueError: if the environment gives no pictures.
        OSError: if the file cannot be written.
    """
    env = make_world(environment)
    try:
        fps = int(env.unwrapped.metadata.get("render_fps") or 10)
        with writing(path, fps) as write:
            count = 0
            for frame in islice(_episodes(agent, env, range(seed, seed + episodes), greedy, fps), MAX_FRAMES):
                write(frame)
                count += 1
    finally:
        env.close()
    return count


@contextmanager
def writing(path: str | Path, fps: int) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """A function that adds a frame, with even sides, to an MP4; the file appears when it is whole, if it has any.

    Raises:
        OSError: if the file cannot be written.
    """
    path = Path(path)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".video-") as folder:
        part = Path(folder) / "video.mp4"
        writer: Any = imageio.get_writer(part, format="FFMPEG", fps=fps, macro_block_size=1, quality=7)
        with writer:
            yield writer.append_data
        if part.exists():
            part.replace(path)


def make_world(environment: EnvironmentSettings) -> VectorEnv:
    """One world that can be drawn and, where it is ours, stays at the end of its episode.

    Raises:
        ValueError: if the environment gives no pictures.
    """
    arguments = {**environment.arguments, "render_mode": "rgb_array"}
    if not is_ours(find_environment(environment.id)):
        env = make_env(environment.id, 1, arguments)
        modes = list(env.unwrapped.metadata.get("render_modes", []))
        if "rgb_array" not in modes:
            env.close()
            raise ValueError(f"environment {environment.id} has no rgb_array rendering; it has {modes}")
        return env
    return gymnasium.make_vec(environment.id, num_envs=1, autoreset_mode=AutoresetMode.DISABLED, **arguments)


def _episodes(
    agent: Agent, env: VectorEnv, seeds: Iterable[int], greedy: bool, fps: int
) -> Iterator[NDArray[np.uint8]]:
    """The frames of one episode per seed; the last of each stands for a moment."""
    for seed in seeds:
        frame: NDArray[np.uint8]
        for frame in episode_frames(agent, env, seed, greedy=greedy):
            yield frame
        yield from [frame] * round(HOLD * fps)


def episode_frames(policy: Policy, env: VectorEnv, seed: int, *, greedy: bool) -> Iterator[NDArray[np.uint8]]:
    """The frames of one episode of ``policy`` in ``env``, from :func:`make_world`, from its start to its end."""
    trained = policy.env
    vehicles, d = trained.vehicles, len(trained.objectives)
    generator = None if greedy else torch.Generator(policy.device).manual_seed(seed)
    worlds = None if isinstance(env.unwrapped, DrivingVectorEnv) else EnvAdapter(env)
    accrued_reward = AccruedReward.begin(1, vehicles, d)
    running = np.ones((1, vehicles), dtype=np.bool_)
    observations = env.reset(seed=seed)[0].reshape(1, vehicles, -1) if worlds is None else worlds.reset(seed)
    yield _picture(env)
    while running.any():
        actions = policy.act(observations, accrued_reward, generator)
        if worlds is None:
            raw, rewards, *flags, _ = env.step(trained.environment_actions(actions))
            observations, rewards = raw.reshape(1, vehicles, -1), rewards.reshape(1, vehicles, d)
            over = (flags[0] | flags[1]).reshape(1, vehicles)
        else:
            step = worlds.step(actions)
            observations, rewards, over = step.observations, step.rewards, step.terminated | step.truncated
        accrued_reward.add(rewards, policy.gamma)
        running &= ~over
        yield _picture(env)


def _picture(env: VectorEnv) -> NDArray[np.uint8]:
    """What the only world looks like, with even sides, as video encoders want them."""
    pictures = env.render()
    if not pictures or not isinstance(pictures[0], np.ndarray):
        raise ValueError("the environment drew nothing")
    height, width = pictures[0].shape[:2]
    return np.pad(pictures[0], ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
