"""What becomes of a trained agent: its scores on new raw environments, tables, figures, videos and the explorer.

What draws and films imports Matplotlib, and is imported when there is something to draw.
"""

from __future__ import annotations

import shlex
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.reporting import run_records
from algorithms.reporting.fronts import FILMED_POLICIES, MAX_FRAMES, caption, covering_policies, front_table
from algorithms.reporting.tables import evaluation_table
from algorithms.reporting.training_log import rows_until
from algorithms.runs.build import make_environment
from algorithms.runs.cli import CHOICE_EPISODES, CHOICE_SPLIT
from algorithms.runs.config import find_environment
from algorithms.runs.console import print_line
from algorithms.runs.interrupts import Accessory
from algorithms.runs.loggers import log_results
from algorithms.runs.run_directory import METRICS_FILE, imported_paths
from mo_deepdrive import suite
from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.episodes import evaluate, parallel_envs
from mo_deepdrive.evaluation.evaluation import Evaluation, write_evaluation
from mo_deepdrive.evaluation.front import FRONT_FILE, Front, best_known_front, indicators, measure_front
from mo_deepdrive.evaluation.metrics import ARRIVED, FRONT, GREEDY, STOCHASTIC, SUCCESS, SUITE
from mo_deepdrive.evaluation.splits import SPLITS, Split, describe_episodes
from mo_deepdrive.evaluation.statistics import Estimate
from mo_deepdrive.suite.scorers import SCORERS
from mo_deepdrive.world.config import is_ours

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from gymnasium.vector import VectorEnv
    from rich.console import Console

    from algorithms.agent import FrontAgent
    from algorithms.reporting.page.data import ExplorableFront
    from algorithms.runs.config import Experiment
    from algorithms.runs.run_directory import Run
    from mo_deepdrive.evaluation.policy import Policy
    from mo_deepdrive.world.config import EnvironmentSettings

VIDEO_FILE = "video.mp4"  # in a run's directory
POLICIES = (GREEDY, STOCHASTIC)
FRONT_EPISODES = 256  # parallel environments for the episodes of all policies of a front


# ----------------------------------------------------------------------------------------------------------- evaluation


def evaluation_env(experiment: Experiment, episodes: int) -> VectorEnv:
    """A raw environment for evaluations of ``episodes`` episodes; the caller closes it."""
    return make_environment(experiment.environment, parallel_envs(experiment.environment.id, episodes))


def distinct_episodes(settings: EnvironmentSettings, episodes: int) -> int:
    """1 if two seeds place the same world of ours, whose episodes are then all the same; else ``episodes``."""
    # Our environments draw random numbers for nothing but the start of an episode; of others this is not known.
    if episodes == 1 or not is_ours(find_environment(settings.id)):
        return episodes
    env: Any = make_environment(settings, 2)
    with closing(env):
        env.reset(seed=[0, 1])
        batch = env.unwrapped.batch
        # A scenario without an obstacle has the coordinates of one that nothing reads.
        names = [name for name in batch.state.dtype.names if name != "obstacle" or batch.params["has_obstacle"].any()]
        return 1 if all(np.array_equal(*batch.state[name]) for name in names) else episodes


def final_metric_names(experiment: Experiment) -> list[str]:
    """The names of the metrics that the final evaluation of an experiment may have, as ``stochastic/success``."""
    settings = experiment.evaluation
    with closing(evaluation_env(experiment, 1)) as env:
        adapter, best_known = EnvAdapter(env), best_known_front(env, settings.gamma)
    if experiment.known_utility:
        shape = (1, adapter.vehicles)
        zeros, ones = np.zeros((*shape, len(adapter.objectives))), np.ones(shape, dtype=np.int64)
        utilities: Any = (lambda returns: returns[..., 0],) * adapter.vehicles
        arrived = np.full(shape, ARRIVED, dtype=object)
        one = Evaluation(adapter.objectives, utilities, zeros, zeros, ones, ones == 1, arrived, zeros)
        known = [f"{policy}/{metric}" for policy in POLICIES for metric in one.metrics()]
    else:
        point = np.zeros((1, adapter.vehicles * len(adapter.objectives)))
        measured = indicators(point, reference_point=settings.reference_point, reference_front=best_known)
        known = [f"{FRONT}/{metric}" for metric in (*measured, SUCCESS)]
    if settings.task is not None:
        columns = SCORERS[suite.load().task(settings.task).score].columns
        known += [f"{policy}/{SUITE}{column}" for policy in POLICIES for column in columns]
    return known


def evaluate_front(agent: FrontAgent, experiment: Experiment, *, episodes: int, seed: int) -> Front:
    """The front of a trained agent, from new episodes, of which :func:`distinct_episodes` are driven."""
    episodes = distinct_episodes(experiment.environment, episodes)
    with closing(evaluation_env(experiment, FRONT_EPISODES)) as env:
        return agent.front(env, episodes=episodes, seed=seed, gamma=experiment.evaluation.gamma)


def evaluate_front_policies(
    agent: FrontAgent, front: Front, experiment: Experiment, *, episodes: int, seed: int
) -> list[Evaluation]:
    """New episodes of every policy of the front that an agent learnt, of which :func:`distinct_episodes` are driven."""
    episodes, gamma = distinct_episodes(experiment.environment, episodes), experiment.evaluation.gamma
    with closing(evaluation_env(experiment, FRONT_EPISODES)) as env:
        return agent.evaluate_policies(front.conditions, env, episodes=episodes, seed=seed, gamma=gamma)


# ------------------------------------------------------------------------------------------------- numbers and pictures


def report_agent(
    agent: Any,
    experiment: Experiment,
    console: Console,
    *,
    episodes: int,
    seed: int,
    title: str = "",
    directory: Path | None = None,
    figures: bool = True,
    video: Path | None = None,
    greedy: bool = True,
    about: Mapping[str, Any] = {},
) -> bool:
    """Evaluate an agent, print a table, and report it where a path is given; False if anything but the numbers failed.

    ``figures`` are those of a front; ``about`` is for evaluation.json. Videos show the first episodes; of a front, four
    greedy policies in the first one.
    """
    gamma, about = experiment.evaluation.gamma, {"step": agent.step, **about}
    if directory is not None:
        directory.mkdir(parents=True, exist_ok=True)
    if not experiment.known_utility:
        front = evaluate_front(agent, experiment, episodes=episodes, seed=seed)
        if front.episodes < episodes:
            console.print(f"every episode is the same: {front.episodes} of {episodes:,} is driven", highlight=False)
        drawn = _report_front(front, experiment, console, directory, about, figures=figures)
        filmed = video is None or film_policies_of_front(agent, front, experiment, video, console, seed=seed)
        return drawn and filmed
    with closing(evaluation_env(experiment, episodes)) as env:
        evaluations = {
            name: evaluate(agent, env, episodes=episodes, seed=seed, greedy=name == GREEDY, gamma=gamma)
            for name in POLICIES
        }
    if directory is not None:
        write_evaluation(directory, evaluations, {**about, "episodes": episodes, "seed": seed, "gamma": gamma})
    console.print(evaluation_table(evaluations, title + describe_episodes(episodes, seed)))
    return video is None or film(agent, experiment, video, console, seed=seed, greedy=greedy)


def _report_front(
    front: Front,
    experiment: Experiment,
    console: Console,
    directory: Path | None,
    about: Mapping[str, Any],
    *,
    figures: bool,
) -> bool:
    """Print a table of a front without dominated policies; with a directory, write it and, with figures, draw it."""
    front, reference_point = front.non_dominated(), experiment.evaluation.reference_point
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
        if figures and directory is not None and len(front.objectives) > 1:  # a single objective has none
            from algorithms.reporting.page.plots import draw_front

            draw_front(front, directory, reference_front=best_known, title=title)
    return drawing.works


def film(
    policy: Policy, experiment: Experiment, path: str | Path, console: Console, *, seed: int, greedy: bool
) -> bool:
    """Try to record a video of a policy from the episode of ``seed`` on; print what it shows, or why there is none."""
    env = experiment.environment
    with _filming(path, f"the {GREEDY if greedy else STOCHASTIC} policy from seed {seed} on", console) as filming:
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
    """Try to film policies of a front, by index, side by side in the same scenario; None films four that cover it."""
    chosen = covering_policies(front, FILMED_POLICIES).tolist() if policies is None else list(policies)
    shown = f"{'policy' if len(chosen) == 1 else 'policies'} {', '.join(map(str, chosen))} of the front, seed {seed}"
    with _filming(path, shown, console) as filming, ExitStack() as stack:
        from algorithms.reporting.videos import DEFAULT_FPS, cut_off, episode_frames, make_render_env, write_video_grid

        tracks = []
        for k in chosen:
            settings = experiment.environment
            env = stack.enter_context(closing(make_render_env(settings.id, settings.arguments)))
            fps = int(env.unwrapped.metadata.get("render_fps") or DEFAULT_FPS)
            frames = episode_frames(agent.policy(front.conditions[k]), env, seed, greedy=True)
            tracks.append((caption(front, k), cut_off(frames, MAX_FRAMES, fps)))
        write_video_grid(tracks, path, fps)
    return filming.works


@contextmanager
def _filming(path: str | Path, shown: str, console: Console) -> Iterator[Accessory]:
    """The context in which a video is written; then its length is printed, or why there is none."""
    with _beside(console, "no video") as accessory:
        yield accessory
        if Path(path).is_file():
            from algorithms.reporting.videos import video_seconds

            print_line(console, f"video: {path}: {shown}, {video_seconds(path):.1f} s")


def _beside(console: Console, failure: str) -> Accessory:
    return Accessory(failure, lambda text: print_line(console, text))


def report_run(run: Run, agent: Any, console: Console, about: Mapping[str, Any] = {}) -> None:
    """The final evaluation of a run, written into its directory; arguments are those of :func:`report_agent`."""
    settings, figures = run.experiment.evaluation, run.experiment.logging.save_figures
    report_agent(
        agent,
        run.experiment,
        console,
        episodes=settings.final_episodes,
        seed=settings.final_seed,
        directory=run.path,
        figures=figures,
        video=run.path / VIDEO_FILE if figures else None,
        about=about,
    )


def show_results(run: Run, step: int, console: Console) -> None:
    """Draw the learning curves of a run that ended at a step, and show its results in TensorBoard; print what fails."""
    with _beside(console, "the curves could not be drawn"):
        # No rows are left if metrics.csv was deleted.
        if run.experiment.logging.save_figures and len(rows_until(run.path / METRICS_FILE, step)):
            from algorithms.reporting.curves import load_groups, plot

            plot(load_groups([run.path]), run.path / "curves.png")
    with _beside(console, "TensorBoard has no results"):
        metrics = run_records.final_metrics(run.path)
        log_results(run.path, step, run.experiment.to_dict(), metrics, run.path / VIDEO_FILE)


# ------------------------------------------------------------------------------------------------------------- explorer


def explorable(
    run: Run,
    agent: FrontAgent,
    name: str,
    *,
    episodes: int = CHOICE_EPISODES,
    split: Split = CHOICE_SPLIT,
    seed: int | None = None,
) -> ExplorableFront:
    """The front of a finished run, as the user calls it, with new episodes of all its policies."""
    from algorithms.reporting.page.data import explorable_front

    front, experiment = Front.read(run.path), run.experiment
    command = f"mo-deepdrive choose {shlex.quote(name)} {{preference}}"
    if imported_paths(experiment.to_dict()):
        command += " --trust"
    if episodes != CHOICE_EPISODES:
        command += f" --episodes {episodes}"
    if seed is not None:
        command += f" --seed {seed}"
    elif split != CHOICE_SPLIT:
        command += f" --split {split}"
    seed = SPLITS[split].start if seed is None else seed
    evaluations = evaluate_front_policies(agent, front, experiment, episodes=episodes, seed=seed)
    gamma = experiment.evaluation.gamma
    return explorable_front(
        agent, front, evaluations, experiment.environment, gamma=gamma, seed=seed, title=name, command=command
    )


def write_explorer(run: Run, agent: FrontAgent, console: Console) -> None:
    """Write the explorer of a run's front into its directory, and print the file or why there is none."""
    with _beside(console, "no explorer"):
        from algorithms.reporting.page.page import EXPLORER_FILE, write_page

        path, name = run.path / EXPLORER_FILE, str(run.path)
        write_page([explorable(run, agent, name)], path, f"Explorer of fronts: {name}")
        print_line(console, f"explorer: {path}: open it in a browser")
