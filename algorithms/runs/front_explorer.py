"""The explorer's page of trained runs."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

from algorithms.reporting.explorer.data import explorable_front
from algorithms.reporting.explorer.page import EXPLORER_FILE, write_page
from algorithms.runs.cli import CHOICE_EPISODES, CHOICE_SPLIT
from algorithms.runs.console import print_line
from algorithms.runs.policy_evaluation import evaluate_front_policies
from algorithms.runs.run_directory import imported_paths
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.splits import SPLITS, Split

if TYPE_CHECKING:
    from rich.console import Console

    from algorithms.agent import FrontAgent
    from algorithms.reporting.explorer.data import ExplorableFront
    from algorithms.runs.run_directory import Run


def explorable(
    run: Run,
    agent: FrontAgent,
    name: str,
    *,
    episodes: int = CHOICE_EPISODES,
    split: Split = CHOICE_SPLIT,
    seed: int | None = None,
) -> ExplorableFront:
    """The front of a finished run with new episodes of all its policies, as ``mo-deepdrive choose`` drives them.

    Args:
        run: with the front of its final evaluation.
        agent: has learnt it.
        name: how the user calls the run.
        episodes: of each policy; one is driven where all are the same.
        split: of the scenario seeds.
        seed: of the first episode, instead of a split.
    """
    front, experiment = Front.read(run.path), run.experiment
    words = ["mo-deepdrive choose", shlex.quote(name), "{preference}"]
    if imported_paths(experiment.to_dict()):
        words.append("--trust")
    if episodes != CHOICE_EPISODES:
        words.append(f"--episodes {episodes}")
    if seed is not None:
        words.append(f"--seed {seed}")
    elif split != CHOICE_SPLIT:
        words.append(f"--split {split}")
    first = SPLITS[split].start if seed is None else seed
    evaluations = evaluate_front_policies(agent, front, experiment, episodes=episodes, seed=first)
    gamma, command = experiment.evaluation.gamma, " ".join(words)
    return explorable_front(
        agent, front, evaluations, experiment.environment, gamma=gamma, seed=first, title=name, command=command
    )


def write_explorer(run: Run, agent: FrontAgent, console: Console) -> None:
    """Write the explorer of a run's front into its directory and print the file."""
    path, name = run.path / EXPLORER_FILE, str(run.path)
    write_page([explorable(run, agent, name)], path, f"Explorer of fronts: {name}")
    print_line(console, f"explorer: {path}: open it in a browser")
