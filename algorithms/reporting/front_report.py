"""A front as numbers, pictures and a video, whichever algorithm found it."""

from __future__ import annotations

from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from algorithms.common.env_adapter import EnvAdapter, make_env
from algorithms.common.pareto import indicators, spread
from algorithms.evaluation.front import Front
from algorithms.evaluation.statistics import Estimate
from algorithms.experiments.config import Experiment
from algorithms.reporting.front_plots import draw_front
from algorithms.reporting.front_view import name_and_unit
from algorithms.reporting.video_grid import write_mosaic
from algorithms.reporting.videos import episode_frames, make_world

if TYPE_CHECKING:
    from algorithms.pcn import PCN

FILMED = 4
MAX_FRAMES = 300  # where a film of several is cut off
ROWS = 12  # of the table; front.csv has all


def best_known_front(env: VectorEnv, gamma: float) -> NDArray[np.float64] | None:
    """The (k, d) best-known returns, discounted with ``gamma``, of an environment; None where it knows none."""
    inner: Any = env.unwrapped
    if not hasattr(inner, "pareto_front"):
        inner = getattr(inner, "envs", [None])[0]
        inner = getattr(inner, "unwrapped", None)
    if not hasattr(inner, "pareto_front"):
        return None
    try:
        return np.array(inner.pareto_front(gamma), dtype=np.float64)
    except ValueError:  # ours say so where there is none for their configuration
        return None


def check_reference_point(experiment: Experiment, objectives: tuple[str, ...]) -> None:
    """Whether the reference point of an experiment fits its environment.

    Raises:
        ValueError: if it has another number of objectives.
    """
    point = experiment.evaluation.reference_point
    if point is not None and len(point) != len(objectives):
        raise ValueError(f"evaluation.reference_point = {point} needs {len(objectives)} numbers: {objectives}")


def report_front(
    experiment: Experiment,
    front: Front,
    console: Console,
    *,
    directory: Path | None,
    step: int,
    about: dict[str, Any] | None = None,
) -> dict[str, float]:
    """Print a table of a front, and write front.csv, evaluation.json and its pictures.

    Args:
        experiment: what found it.
        front: re-evaluated policies; only those that no other dominates are shown and written.
        console: where to print.
        directory: where to write; None for nowhere.
        step: environment steps that the policies took to learn.
        about: anything else for evaluation.json.

    Returns:
        The indicators by name.

    Raises:
        OSError: if a file cannot be written; each is whole or untouched.
    """
    front = front.non_dominated()
    env = make_env(experiment.environment.id, 1, experiment.environment.arguments)
    try:
        known = best_known_front(env, front.gamma)
        scales = EnvAdapter(env).objective_scales
    finally:
        env.close()
    found = measure(front, experiment, known, scales)
    title = f"{experiment.algorithm['name']} on {experiment.environment.id}"
    console.print(front_table(front, found, f"{title}: {len(front)} policies"))
    if directory is not None:
        policies = {"front": {name: asdict(Estimate(value)) for name, value in found.items()}}
        point = experiment.evaluation.reference_point
        front.write(directory, {"step": step, **(about or {}), "reference_point": point, "policies": policies})
        if len(front.objectives) > 1:
            draw_front(front, directory, reference_front=known, title=title)
    return found


def measure(
    front: Front, experiment: Experiment, known: NDArray[np.float64] | None, scales: NDArray[np.float32]
) -> dict[str, float]:
    """The indicators of a front, and the share of its policies' episodes that arrived where that is known."""
    found = indicators(
        front.discounted,
        reference_point=experiment.evaluation.reference_point,
        reference_front=known,
        scales=scales,
    )
    if np.isfinite(front.success).all():
        found["success"] = float(front.success.mean())
    return found


def representatives(front: Front, count: int) -> NDArray[np.intp]:
    """``count`` policies that cover a front (all where it has fewer), by the return of the first objective."""
    extent = np.ptp(front.returns, axis=0)
    chosen = spread(front.returns, count, np.where(extent > 0.0, extent, 1.0))
    return chosen[np.argsort(front.returns[chosen, 0], kind="stable")]


def front_table(front: Front, found: dict[str, float], title: str) -> Group:
    """Some policies of a front, with the intervals of their returns, and its indicators below."""
    numbers = [
        f"{name.replace('_', ' ')} {f'{value:,.0f}' if value >= 1e4 else f'{value:.4g}'}"
        for name, value in found.items()
    ]
    table = Table(box=SIMPLE_HEAD)
    arrivals = bool(np.isfinite(front.success).all())
    table.add_column("policy", justify="right")
    for name in (*front.objectives, *(["arrivals"] if arrivals else []), "decisions"):
        table.add_column(name, justify="right", no_wrap=True)
    for k in representatives(front, ROWS).tolist():
        cells = [
            Estimate(*(float(array[k, i]) for array in (front.returns, front.low, front.high))).text()
            if front.episodes > 1
            else f"{front.returns[k, i]:.4g}"
            for i in range(len(front.objectives))
        ]
        share = [f"{front.success[k]:.0%}"] if arrivals else []
        row = [str(k), *cells, *share, f"{front.length[k]:.0f}"]
        table.add_row(*(cell.replace("[", r"\[") for cell in row))
    how = "1 episode each" if front.episodes == 1 else f"{front.episodes} episodes each, 95% intervals"
    heading = Text(f"{title}; undiscounted returns, {how}", style="bold")
    return Group(heading, table, Text(", ".join(numbers)))


def caption(front: Front, k: int) -> str:
    """What policy ``k`` returns, in words: ``policy 3: distance 14.5 m, g-force -5.8 g``."""
    named = [name_and_unit(objective) for objective in front.objectives]
    parts = [f"{name} {value:.3g} {unit}".rstrip() for (name, unit), value in zip(named, front.returns[k], strict=True)]
    return f"policy {k}: {', '.join(parts)}"


def film_front(
    agent: PCN, front: Front, experiment: Experiment, path: str | Path, *, seed: int, policies: Any = None
) -> int:
    """Record policies of a front side by side, each in the same scenario.

    Args:
        agent: who drives.
        front: of the agent.
        experiment: what it was trained on.
        path: the file.
        seed: of the scenario.
        policies: which; four that cover the front if None.

    Returns:
        The number of frames.

    Raises:
        ValueError: if the environment gives no pictures.
        OSError: if the file cannot be written.
    """
    chosen = representatives(front, FILMED) if policies is None else np.asarray(policies)
    envs = [make_world(experiment.environment) for _ in chosen]
    fps = int(envs[0].unwrapped.metadata.get("render_fps") or 10)
    try:
        tracks = []
        for k, env in zip(chosen, envs, strict=True):
            frames = episode_frames(agent.policy(front.conditions[k]), env, seed, greedy=True)
            tracks.append((caption(front, int(k)), islice(frames, MAX_FRAMES)))
        return write_mosaic(tracks, path, fps)
    finally:
        for env in envs:
            env.close()
