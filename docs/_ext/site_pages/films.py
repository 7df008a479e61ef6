"""The moving picture of every environment, and the picture of its best-known front."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms import zoo
from algorithms.common.yaml_io import read_mapping
from algorithms.experiments.config import find_environment
from algorithms.zoo import ABOUT, CONFIG
from mo_deepdrive import reference_fronts
from mo_deepdrive.action_sequences import decode, discounted_sum, replay
from mo_deepdrive.config import EnvConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from mo_deepdrive.scenarios import Scenario

SEED = 1_000_001  # of the first episode
MAX_FRAMES = 180


def policy_of(scenario: Scenario) -> str | None:
    """The policy of the zoo that arrives most often in a scenario with default arguments; None if there is none."""
    found: list[tuple[float, str]] = []
    for name in zoo.names():
        environment = read_mapping(zoo.find(name) / CONFIG)["environment"]
        scores = json.loads((zoo.find(name) / ABOUT).read_text(encoding="utf-8")).get("scores", {})
        if find_environment(environment["id"]).kwargs.get("scenario") == scenario.name and "greedy" in scores:
            given = EnvConfig(scenario=scenario.name, **environment["arguments"])
            if given == EnvConfig(scenario=scenario.name):
                found.append((-scores["greedy"]["success"], name))
    return min(found)[1] if found else None


def film_caption(scenario: Scenario) -> str:
    """What the moving picture shows."""
    policy = policy_of(scenario)
    return f"The policy `{policy}` of the zoo, greedy." if policy else "Random actions."


def write_film(scenario: Scenario, path: Path) -> None:
    """Write the GIF of a scenario: episodes of its best policy of the zoo, or of random actions."""
    from algorithms.experiments.build import load_policy
    from algorithms.experiments.run_directory import Run
    from algorithms.reporting.animated_gif import write_gif
    from algorithms.reporting.videos import episode_frames, make_render_env

    policy = policy_of(scenario)
    if policy is None:
        frames = _random_frames(scenario)
    else:
        agent, env = load_policy(Run.open(policy, device="cpu")), make_render_env(scenario.id)
        frames = (frame for seed in range(SEED, SEED + 20) for frame in episode_frames(agent, env, seed, greedy=True))
    shown = [frame for _, frame in zip(range(MAX_FRAMES), frames, strict=False)]
    write_gif([(scenario.title, shown)], path, fps=10, side=320)


def _random_frames(scenario: Scenario) -> Iterator[NDArray[np.uint8]]:
    import gymnasium

    env = gymnasium.make(scenario.id, render_mode="rgb_array", disable_env_checker=True)
    env.action_space.seed(SEED)
    for seed in range(SEED, SEED + 20):
        env.reset(seed=seed)
        over = False
        while not over:
            frame: Any = env.render()
            yield frame
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated


def write_front(scenario: Scenario, kind: str, path: Path) -> None:
    """Draw the best-known front of a scenario, returns of two objectives at a time."""
    from algorithms.reporting.front_plots import draw_front
    from mo_deepdrive.evaluation.front import Front

    policies = reference_fronts.shipped(scenario.name, kind)
    config = reference_fronts.front_config(scenario.name, kind)
    rewards = replay(config, [decode(policy.actions, kind) for policy in policies])
    returns = discounted_sum(rewards, 1.0)
    discounted = discounted_sum(rewards, reference_fronts.GAMMA)
    kept = _non_dominated(discounted)
    arrived = rewards[kept][:, :, scenario.objectives.index("destination")].any(axis=1).astype(np.float64)
    front = Front(
        objectives=scenario.objectives,
        returns=returns[kept],
        low=returns[kept],
        high=returns[kept],
        discounted=discounted[kept],
        success=arrived,
        length=(rewards[kept] != 0).any(axis=2).sum(axis=1).astype(np.float64),
        conditions=np.zeros((len(kept), 0)),
        condition_names=(),
        gamma=reference_fronts.GAMMA,
        episodes=1,
        seed=0,
    )
    with tempfile.TemporaryDirectory() as folder:
        draw_front(front, folder, title=f"best-known front, {scenario.title}, {kind}")
        path.write_bytes((Path(folder) / "scatter.png").read_bytes())


def _non_dominated(returns: NDArray[np.float64]) -> NDArray[np.intp]:
    import moocore

    kept: NDArray[np.intp] = np.flatnonzero(moocore.is_nondominated(returns, maximise=True))
    return kept
