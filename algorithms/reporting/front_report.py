"""Reports of a front, whichever algorithm found it: a table, files, figures and a video.

What draws and films imports Matplotlib and others, which may fail: it is imported when there is something to draw.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from rich.console import Group
from rich.text import Text

from algorithms.reporting.wide_tables import fitted_tables
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.front import FRONT_FILE, Front, best_known_front, measure_front
from mo_deepdrive.evaluation.metrics import FRONT, name_and_unit
from mo_deepdrive.evaluation.pareto import farthest_point_subset
from mo_deepdrive.evaluation.statistics import MIN_SAMPLES, Estimate, of_three

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray
    from rich.console import Console

    from mo_deepdrive.evaluation.policy import Policy

FILMED_POLICIES = 4
MAX_FRAMES = 1000  # of every policy that is filmed; an episode of ours has 601 unless its time limit is changed
TABLE_ROWS = 12  # policies in the table; front.csv has all


class ConditionedPolicies(Protocol):
    """What has a policy for every condition: an agent that has learnt a front, or another library's policies."""

    def policy(self, condition: NDArray[np.float64]) -> Policy:
        """The policy under ``condition`` (m,), a row of :attr:`Front.conditions`."""


def report_front(
    front: Front,
    console: Console,
    *,
    algorithm: str,
    env_id: str,
    env_arguments: Mapping[str, Any],
    reference_point: Sequence[float] | None,
    directory: Path | None,
    about: Mapping[str, Any],
) -> dict[str, float]:
    """Write front.csv and evaluation.json of a front, and print a table.

    Args:
        front: evaluated policies; those that another one dominates are neither shown nor written.
        console: where to print.
        algorithm: its name.
        env_id: of the environment.
        env_arguments: keyword arguments of the environment.
        reference_point: (d,) of the hypervolume; None for no hypervolume.
        directory: where to write; None to write nothing.
        about: anything else for evaluation.json, such as the step.

    Returns:
        The indicators by metric.

    Raises:
        OSError: if a file cannot be written; each file is complete or unchanged.
    """
    front = front.non_dominated()
    env = make_env(env_id, 1, dict(env_arguments))
    try:
        reference_front = best_known_front(env, front.gamma)
        scales = EnvAdapter(env).joint_scales
    finally:
        env.close()
    measured = measure_front(front, reference_point=reference_point, reference_front=reference_front, scales=scales)
    title = f"{algorithm} on {env_id}"
    whole = "--output DIR writes all" if directory is None else f"all are in {directory / FRONT_FILE}"
    if directory is not None:
        policies = {FRONT: {name: asdict(Estimate(value)) for name, value in measured.items()}}
        front.write(directory, {**about, "reference_point": reference_point, "policies": policies})
    console.print(front_table(front, measured, title, console.width, whole))
    return measured


def draw_report(
    front: Front, directory: Path, *, algorithm: str, env_id: str, env_arguments: Mapping[str, Any]
) -> None:
    """Draw the figures of a front that :func:`report_front` has reported; there are none of a single objective.

    Args:
        front: as there; this and the others.
        directory: where to write.
        algorithm: its name.
        env_id: of the environment.
        env_arguments: keyword arguments of the environment.

    Raises:
        OSError: if a file cannot be written; each file is complete or unchanged.
    """
    if len(front.objectives) < 2:
        return
    from algorithms.reporting.front_plots import draw_front

    env = make_env(env_id, 1, dict(env_arguments))
    try:
        best_known = best_known_front(env, front.gamma)
    finally:
        env.close()
    draw_front(front.non_dominated(), directory, reference_front=best_known, title=f"{algorithm} on {env_id}")


def covering_policies(front: Front, count: int) -> NDArray[np.intp]:
    """``count`` policies that cover a front (all if it has fewer), judged and ordered by discounted returns."""
    extent = np.ptp(front.discounted, axis=0)
    chosen = farthest_point_subset(front.discounted, count, np.where(extent > 0.0, extent, 1.0))
    return chosen[np.argsort(front.discounted[chosen, 0], kind="stable")]


def front_table(front: Front, measured: Mapping[str, float], title: str, width: int, whole: str = "") -> Group:
    """A table of some policies of a front with the intervals of their returns, and the front's indicators below it.

    Args:
        front: evaluated policies; of more than TABLE_ROWS those are shown that cover it.
        measured: the indicators.
        title: what the front belongs to.
        width: columns of the terminal: objectives that do not fit are in a further table.
        whole: where all policies are, for a front that is not shown as a whole.
    """
    numbers = [
        f"{name.replace('_', ' ')} {f'{value:,.0f}' if value >= 1e4 else f'{value:.4g}'}"
        for name, value in measured.items()
    ]
    arrivals = bool(np.isfinite(front.success).all())
    shown = [i for i in range(len(front.objectives)) if not front.is_arrival_rate(i)]
    names = [front.objectives[i] for i in shown]
    rows = [["policy", *names, *(["arrivals"] if arrivals else []), "decisions"]]
    chosen = covering_policies(front, TABLE_ROWS).tolist()
    for k in chosen:
        cells = [
            Estimate(*(float(array[k, i]) for array in (front.returns, front.low, front.high))).text()
            if front.episodes >= MIN_SAMPLES
            else f"{front.returns[k, i]:.4g}"
            for i in shown
        ]
        share = [f"{front.success[k]:.0%}"] if arrivals else []
        rows.append([str(k), *cells, *share, f"{front.length[k]:.0f}"])
    how = f"{front.episodes} episode{'' if front.episodes == 1 else 's'} each"
    how += f", 95% intervals{of_three([front.episodes], 'episodes')}" if front.episodes >= MIN_SAMPLES else ""
    count = f"{len(front)} policies"
    if len(chosen) < len(front):
        count = f"{len(chosen)} of {count}, which cover the front" + (f" ({whole})" if whole else "")
    heading = Text(f"{title}: {count}; undiscounted returns, {how}", style="bold")
    return Group(heading, *fitted_tables(rows, 1, width), Text(", ".join(numbers)))


def caption(front: Front, k: int) -> str:
    """The returns of policy ``k`` in words: ``policy 3, mean of 100 episodes: distance 14.5 m, g-force -5.8 g``."""
    named = [name_and_unit(objective) for objective in front.objectives]
    parts = [f"{name} {value:.3g} {unit}".rstrip() for (name, unit), value in zip(named, front.returns[k], strict=True)]
    episodes = f", mean of {front.episodes} episodes" if front.episodes > 1 else ""
    return f"policy {k}{episodes}: {', '.join(parts)}"


def film_front(
    agent: ConditionedPolicies,
    front: Front,
    env_id: str,
    env_arguments: Mapping[str, Any],
    path: str | Path,
    *,
    seed: int,
    policies: ArrayLike | None = None,
) -> int:
    """Record whole episodes of policies of a front side by side, all in the same scenario.

    An episode of more than MAX_FRAMES frames is cut off, which its last frame says.

    Args:
        agent: has the policies.
        front: of the agent.
        env_id: of the environment that the agent was trained on.
        env_arguments: keyword arguments of the environment.
        path: the MP4 file.
        seed: of the scenario.
        policies: indices of the policies; four that cover the front if None.

    Returns:
        The number of frames.

    Raises:
        ValueError: if the environment cannot be rendered.
        OSError: if the file cannot be written.
    """
    from algorithms.reporting.video_grid import write_video_grid
    from algorithms.reporting.videos import DEFAULT_FPS, cut_off, episode_frames, make_render_env

    chosen = covering_policies(front, FILMED_POLICIES) if policies is None else np.asarray(policies)
    envs = [make_render_env(env_id, env_arguments) for _ in chosen]
    fps = int(envs[0].unwrapped.metadata.get("render_fps") or DEFAULT_FPS)
    try:
        tracks = []
        for k, env in zip(chosen, envs, strict=True):
            frames = episode_frames(agent.policy(front.conditions[k]), env, seed, greedy=True)
            tracks.append((caption(front, int(k)), cut_off(frames, MAX_FRAMES, fps)))
        return write_video_grid(tracks, path, fps)
    finally:
        for env in envs:
            env.close()
