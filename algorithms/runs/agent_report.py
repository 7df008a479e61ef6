"""Evaluate a trained agent: write the numbers, print a table, draw figures and record a video.

What draws and films imports Matplotlib, and is imported when there is something to draw.
"""

from __future__ import annotations

from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from algorithms.reporting.fronts import FILMED_POLICIES, MAX_FRAMES, caption, covering_policies, front_table
from algorithms.reporting.run_records import final_metrics
from algorithms.reporting.tables import evaluation_table
from algorithms.reporting.training_log import rows_until
from algorithms.runs.accessories import Accessory
from algorithms.runs.build import make_environment
from algorithms.runs.console import print_line
from algorithms.runs.loggers import log_results
from algorithms.runs.policy_evaluation import evaluate_front, evaluate_policies
from algorithms.runs.run_directory import METRICS_FILE
from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.evaluation_files import write_evaluation
from mo_deepdrive.evaluation.front import FRONT_FILE, best_known_front, measure_front
from mo_deepdrive.evaluation.metrics import FRONT, GREEDY, STOCHASTIC
from mo_deepdrive.evaluation.splits import describe_episodes
from mo_deepdrive.evaluation.statistics import Estimate

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from rich.console import Console

    from algorithms.runs.config import Experiment
    from algorithms.runs.run_directory import Run
    from mo_deepdrive.evaluation.front import Front
    from mo_deepdrive.evaluation.policy import Policy

VIDEO_FILE = "video.mp4"  # in a run's directory


def report_agent(
    agent: Any,
    experiment: Experiment,
    console: Console,
    *,
    episodes: int,
    seed: int,
    title: str = "",
    directory: Path | None = None,
    video: Path | None = None,
    greedy: bool = True,
    about: Mapping[str, Any] = {},
) -> bool:
    """Evaluate an agent; write the numbers, print a table, draw figures and film the policy where a path is given.

    Args:
        agent: trained; its ``step`` is reported.
        experiment: what it was trained on.
        console: where to print.
        episodes: number of episodes of each policy.
        seed: seed of the first episode.
        title: beginning of the table's title.
        directory: where to write evaluation.json and so on.
        video: file of a video of the first episodes; of a front, four policies in the first episode.
        greedy: film the greedy policy instead of the stochastic one; of a front the greedy policies are filmed.
        about: anything else for evaluation.json.

    Returns:
        False if anything but the numbers failed, such as the video, which is printed.
    """
    if directory is not None:
        directory.mkdir(parents=True, exist_ok=True)
    if not experiment.known_utility:
        front = evaluate_front(agent, experiment, episodes=episodes, seed=seed)
        if front.episodes < episodes:
            console.print(f"every episode is the same: {front.episodes} of {episodes:,} is driven", highlight=False)
        _, drawn = report_front(front, experiment, console, directory, {"step": agent.step, **about})
        filmed = video is None or film_policies_of_front(agent, front, experiment, video, console, seed=seed)
        return drawn and filmed
    evaluations = evaluate_policies(agent, experiment, episodes=episodes, seed=seed)
    if directory is not None:
        measured = {"episodes": episodes, "seed": seed, "gamma": experiment.evaluation.gamma}
        write_evaluation(directory, evaluations, {"step": agent.step, **about, **measured})
    console.print(evaluation_table(evaluations, title + describe_episodes(episodes, seed)))
    return video is None or film(agent, experiment, video, console, seed=seed, greedy=greedy)


def report_front(
    front: Front, experiment: Experiment, console: Console, directory: Path | None, about: Mapping[str, Any]
) -> tuple[dict[str, float], bool]:
    """Print a table of a front; write front.csv and evaluation.json, and draw it, if there is a directory.

    Args:
        front: evaluated policies; those that another one dominates are neither shown nor written.
        experiment: in which it was learnt.
        console: where to print.
        directory: where to write; None to write nothing.
        about: anything else for evaluation.json, such as the step.

    Returns:
        The indicators by metric, and whether the front could be drawn; if not, the reason is printed.
    """
    front = front.non_dominated()
    reference_point = experiment.evaluation.reference_point
    with closing(make_environment(experiment.environment, 1)) as env:
        best_known, scales = best_known_front(env, front.gamma), EnvAdapter(env).joint_scales
    measured = measure_front(front, reference_point=reference_point, reference_front=best_known, scales=scales)
    title = f"{experiment.algorithm.name} on {experiment.environment.id}"
    whole = "--output DIR writes all" if directory is None else f"all are in {directory / FRONT_FILE}"
    if directory is not None:
        policies = {FRONT: {name: asdict(Estimate(value)) for name, value in measured.items()}}
        front.write(directory, {**about, "reference_point": reference_point, "policies": policies})
    console.print(front_table(front, measured, title, console.width, whole))
    with _beside(console, "the front could not be drawn") as drawing:
        if directory is not None and len(front.objectives) > 1:  # there are no figures of a single objective
            from algorithms.reporting.explorer.plots import draw_front

            draw_front(front, directory, reference_front=best_known, title=title)
    return measured, drawing.works


def film(
    policy: Policy, experiment: Experiment, path: str | Path, console: Console, *, seed: int, greedy: bool = True
) -> bool:
    """Record a video of a policy from the episode of ``seed`` on; print what it shows, or why there is none.

    Args:
        policy: an agent, or anything that acts like one.
        experiment: its environment.
        path: the file.
        console: where to print.
        seed: seed of the first episode.
        greedy: argmax or mean actions, instead of samples.

    Returns:
        Whether there is a video.
    """
    env = experiment.environment
    what = f"the {GREEDY if greedy else STOCHASTIC} policy from seed {seed} on"
    with _filming(path, what, console) as filming:
        from algorithms.reporting.videos import record

        record(policy, env.id, env.arguments, path, seed=seed, greedy=greedy)
    return filming.works


def film_policies_of_front(
    agent: Any,
    front: Front,
    experiment: Experiment,
    path: str | Path,
    console: Console,
    *,
    seed: int,
    policies: Sequence[int] | None = None,
) -> bool:
    """Record a video of policies of a front side by side and print what it shows, or why there is none.

    All drive in the same scenario. An episode of more than MAX_FRAMES frames is cut off, which its last frame says.

    Args:
        agent: the agent that learnt the front.
        front: its policies.
        experiment: its environment.
        path: the file.
        console: where to print.
        seed: seed of the episode.
        policies: indices of the policies; four that cover the front if None.

    Returns:
        Whether there is a video.
    """
    chosen = covering_policies(front, FILMED_POLICIES).tolist() if policies is None else list(policies)
    what = f"{'policy' if len(chosen) == 1 else 'policies'} {', '.join(map(str, chosen))} of the front, seed {seed}"

    with _filming(path, what, console) as filming:
        from algorithms.reporting.videos import DEFAULT_FPS, cut_off, episode_frames, make_render_env, write_video_grid

        settings = experiment.environment
        with ExitStack() as stack:
            tracks = []
            for k in chosen:
                env = stack.enter_context(closing(make_render_env(settings.id, settings.arguments)))
                fps = int(env.unwrapped.metadata.get("render_fps") or DEFAULT_FPS)
                frames = episode_frames(agent.policy(front.conditions[k]), env, seed, greedy=True)
                tracks.append((caption(front, k), cut_off(frames, MAX_FRAMES, fps)))
            write_video_grid(tracks, path, fps)
    return filming.works


@contextmanager
def _filming(path: str | Path, what: str, console: Console) -> Iterator[Accessory]:
    """The context in which a video is written; then its length is printed, or why there is none."""
    with _beside(console, "no video") as accessory:
        yield accessory
        if Path(path).is_file():
            from algorithms.reporting.videos import video_seconds

            print_line(console, f"video: {path}: {what}, {video_seconds(path):.1f} s")


def _beside(console: Console, failure: str) -> Accessory:
    return Accessory(failure, lambda text: print_line(console, text))


def show_results(run: Run, step: int, console: Console) -> None:
    """Draw the learning curves of a run that ended at a step, and show its results in TensorBoard; print what fails."""
    with _beside(console, "the curves could not be drawn"):
        # No rows are left if metrics.csv was deleted.
        if run.experiment.logging.save_figures and rows_until(run.path / METRICS_FILE, step)[1]:
            from algorithms.reporting.curves import load_groups, plot

            plot(load_groups([run.path]), run.path / "curves.png")
    with _beside(console, "TensorBoard has no results"):
        log_results(run.path, step, run.experiment.to_dict(), final_metrics(run.path), run.path / VIDEO_FILE)
