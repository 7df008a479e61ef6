"""What fixed rules and learnt policies achieve in LeftTurn: a table and a picture, from risky to safe."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from algorithms.driving.left_turn_rules import SCENARIO, GapDriver, GapRule
from algorithms.experiments.build import load_policy
from algorithms.reporting.animated_gif import write_gif
from algorithms.reporting.style import algorithm_colours, figure_style, save_figure, surround
from algorithms.reporting.videos import episode_frames, make_render_env
from mo_deepdrive.atomic_io import atomic_write, csv_bytes
from mo_deepdrive.evaluation.accrued_reward import AccruedReward
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.function_policy import FunctionPolicy
from mo_deepdrive.evaluation.metrics import COLLISION, UTILITY_SER
from mo_deepdrive.evaluation.policy import seeded_generator
from mo_deepdrive.evaluation.splits import first_seed
from mo_deepdrive.evaluation.statistics import Estimate, mean, rate, utility_of_mean
from mo_deepdrive.utilities import make_utility

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    import torch
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from algorithms.agent import Agent
    from algorithms.experiments.run_directory import Run
    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.function_policy import PolicyFunction
    from mo_deepdrive.evaluation.splits import Split

RISK_AVERSE = "left_turn_risk_averse"
# Of the table, in order. Time and comfort are those of the episodes that arrive: a collision ends an episode early.
AMOUNTS = ("time", "g_force", "jerk", "lane_violation")
UTILITIES = ("left_turn_linear", "left_turn_comfort_budget", RISK_AVERSE)
OBJECTIVES = [*SCENARIO.objectives, "near_miss"]  # in this order


SHOWN = "stochastic"  # of the learnt policies, those in the picture
BEST_RULE = "minus_best_rule"  # the score that compares utilities


@dataclass(frozen=True)
class DriverScores:
    """Scores of one driver, by name.

    Attributes:
        driver: what is scored.
        gap: of a rule, the gap for which it waits (s); None for a learnt policy.
        episodes: of the evaluation.
        estimates: every score with its 95% interval over the episodes.
        utilities: (E,) ``left_turn_linear`` of every episode.
        algorithm: of a learnt policy; "" for a rule.
    """

    driver: str
    gap: float | None
    episodes: int
    estimates: dict[str, Estimate]
    utilities: NDArray[np.float64]
    algorithm: str = ""


def score_rules(
    gaps: Iterable[float], *, episodes: int, split: Split = "test", traffic: str = "default", actions: str = "discrete"
) -> list[DriverScores]:
    """Evaluate the rule that waits for a gap, for each of ``gaps`` (s), on the same scenarios.

    Args:
        gaps: the gaps; 0 is to go at once.
        episodes: of every rule.
        split: the scenarios.
        traffic: flow of the oncoming cars.
        actions: action type.

    Raises:
        ValueError: for an invalid gap or argument of the environment, or more episodes than the split has.
    """
    rules = [GapRule(gap=gap) for gap in gaps]
    arguments = {"traffic": traffic, "action_type": actions, "objectives": OBJECTIVES}
    return [
        _scores(
            f"waits for {rule.gap:g} s" if rule.gap else "goes at once",
            rule.gap,
            evaluate(GapDriver(rule, actions), SCENARIO.id, split=split, episodes=episodes, env_kwargs=arguments),
        )
        for rule in rules
    ]


def load_turner(run: Run) -> Agent:
    """The trained agent of a run in LeftTurn.

    Raises:
        ValueError: for a run of another environment or of other objectives.
    """
    agent: Agent = load_policy(run)
    if agent.env.name != SCENARIO.id or agent.env.objectives != SCENARIO.objectives:
        raise ValueError(
            f"{str(run.path)!r} is of {agent.env.name} with the objectives {', '.join(agent.env.objectives)}; "
            f"expected {SCENARIO.id} with {', '.join(SCENARIO.objectives)}"
        )
    return agent


def score_runs(
    runs: Iterable[Run], *, episodes: int, split: Split = "test", traffic: str = "default"
) -> list[DriverScores]:
    """Evaluate the stochastic and the greedy policy of each run, on the scenarios of :func:`score_rules`.

    Args:
        runs: trained in LeftTurn, with its objectives.
        episodes: of every policy.
        split: the scenarios.
        traffic: flow of the oncoming cars, whatever the run was trained in.

    Returns:
        Two per run, in the order of the runs.

    Raises:
        ValueError: for a run of another environment or of other objectives, or one that learns a front.
    """
    found = []
    for run in runs:
        experiment = run.experiment
        if not experiment.known_utility:
            raise ValueError(f"{str(run.path)!r} is a front of policies, not one")
        agent = load_turner(run)
        arguments = {**experiment.environment.arguments, "traffic": traffic, "objectives": OBJECTIVES}
        algorithm = experiment.algorithm.name
        for kind in (SHOWN, "greedy"):
            generator = seeded_generator(agent, first_seed(split, None, episodes)) if kind == SHOWN else None
            evaluation = evaluate(
                _acting(agent, generator),
                SCENARIO.id,
                split=split,
                episodes=episodes,
                env_kwargs=arguments,
                gamma=agent.accrued_discount,
            )
            driver = f"{algorithm}, seed {experiment.training.seed}, {kind}"
            found.append(_scores(driver, None, evaluation, algorithm))
    return found


def _acting(agent: Agent, generator: torch.Generator | None) -> PolicyFunction:
    """An agent as a function, to which the accrued near misses, the last objective, are not shown."""
    own = len(agent.env.objectives)

    def act(observations: NDArray[Any], accrued: NDArray[Any], discounts: NDArray[Any]) -> NDArray[Any]:
        past = AccruedReward(accrued[:, None, :own], discounts[:, None], np.zeros((len(accrued), 1), dtype=np.int64))
        return agent.env.environment_actions(agent.act(observations[:, None], past, generator))

    return act


def compare_with_best_rule(scores: Sequence[DriverScores]) -> list[DriverScores]:
    """The scores, those of learnt policies with the gain in ``left_turn_linear`` over the best rule of ``scores``.

    The gain is the mean difference over the episodes, which are the same for all drivers.

    Raises:
        ValueError: if no rule is among them.
    """
    rules = [each for each in scores if each.gap is not None]
    if not rules:
        raise ValueError("there is no rule to compare with")
    best = max(rules, key=lambda each: each.utilities.mean())
    return [
        replace(each, estimates={**each.estimates, BEST_RULE: mean(each.utilities - best.utilities)}) for each in scores
    ]


def _scores(driver: str, gap: float | None, evaluation: Evaluation, algorithm: str = "") -> DriverScores:
    own = evaluation.returns[:, 0, : len(SCENARIO.objectives)]
    utilities = np.asarray(make_utility("left_turn_linear", SCENARIO.objectives)(own))
    return DriverScores(driver, gap, len(own), _estimates(evaluation), utilities, algorithm)


def _estimates(evaluation: Evaluation) -> dict[str, Estimate]:
    returns = evaluation.returns[:, 0]
    by_name = dict(zip(evaluation.objectives, -returns.T, strict=True))
    arrived = evaluation.succeeded[:, 0]
    found = {
        "arrived": rate(arrived),
        "collision": rate(evaluation.ends[:, 0] == COLLISION),
        "near_miss": rate(by_name["near_miss"] > 0.0),
    }
    found |= {name: mean(by_name[name][arrived]) if arrived.any() else Estimate(np.nan) for name in AMOUNTS}
    own = returns[:, : len(SCENARIO.objectives)]
    for name in UTILITIES:
        found[name] = mean(np.asarray(make_utility(name, SCENARIO.objectives)(own)))
    averse = make_utility(RISK_AVERSE, SCENARIO.objectives)
    return {**found, f"{RISK_AVERSE}/{UTILITY_SER}": utility_of_mean(own, averse)}


def rows(scores: Sequence[DriverScores]) -> list[list[str]]:
    """The table as text, header first."""
    names = list(scores[0].estimates)
    return [["driver", *names], *([each.driver, *(each.estimates[name].text() for name in names)] for each in scores)]


def write_scores(path: Path, scores: Sequence[DriverScores]) -> None:
    """Write a CSV with a row per driver, and of every score its value and both ends of its interval.

    Raises:
        OSError: if the file cannot be written; it is complete or unchanged.
    """
    names = list(scores[0].estimates)
    header = ["driver", "gap", "episodes", *(f"{name}{end}" for name in names for end in ("", "_low", "_high"))]
    body = [
        [
            each.driver,
            "" if each.gap is None else each.gap,
            each.episodes,
            *(
                "" if number is None else round(number, 5)
                for name in names
                for number in (each.estimates[name].value, each.estimates[name].low, each.estimates[name].high)
            ),
        ]
        for each in scores
    ]
    atomic_write(path, csv_bytes([header, *body]))


def plot_scores(path: Path, scores: Sequence[DriverScores], note: str) -> None:
    """Draw arrivals and collisions, near misses, comfort and utility against the time that an arrival takes.

    Args:
        path: the image.
        scores: one per rule.
        note: what was evaluated, below the title.

    Raises:
        OSError: if the file cannot be written.
    """
    panels = (
        ("share of episodes", (("arrived", "arrived", "#0b6e4f"), ("collision", "collided", "#c1121f"))),
        ("share with a near miss", (("near_miss", "near miss", "#e07a1f"),)),
        ("g-force (sum, g)", (("g_force", "g-force", "#3d5a98"),)),
        ("jerk (sum, m/s³)", (("jerk", "jerk", "#3d5a98"),)),
        ("left_turn_linear", (("left_turn_linear", "utility", "#6a4c93"),)),
    )
    rules = [each for each in scores if each.gap is not None]
    learnt = [each for each in scores if each.algorithm and each.driver.endswith(SHOWN)]
    colours = algorithm_colours(each.algorithm for each in learnt)
    with figure_style():
        figure = Figure(figsize=(13.5, 2.6))
        axes = figure.subplots(1, len(panels))
        for axis, (title, lines) in zip(axes, panels, strict=True):
            axis.set_title(title)
            axis.set_xlabel("time of an arrival (s)")
            for name, label, colour in lines:
                _draw_rules(axis, rules, name, label, colour)
                for each in learnt:
                    _draw_learnt(axis, each, name, colours[each.algorithm])
            axis.margins(0.12)
        handles = [
            Line2D([], [], color=colour, marker="o", label=label)
            for _, lines in panels[:1]
            for _, label, colour in lines
        ]
        handles += [
            Line2D([], [], color=colour, marker="D", linestyle="", label=name) for name, colour in colours.items()
        ]
        notes = [note, "numbers: the gap in seconds for which the rule waits; bars: 95% intervals over the episodes"]
        if learnt:
            notes.append("diamonds: learnt policies, one per training seed, which sample their actions")
        surround(figure, "LeftTurn: what fixed rules and learnt policies achieve", notes, handles)
        save_figure(figure, path)


def _draw_rules(axis: Axes, rules: Sequence[DriverScores], name: str, label: str, colour: str) -> None:
    times = [each.estimates["time"].value for each in rules]
    values = [each.estimates[name].value for each in rules]
    errors = np.transpose([_bars(each.estimates[name]) for each in rules])
    axis.errorbar(times, values, yerr=errors, color=colour, marker="o", markersize=4, capsize=2, label=label)
    for time, value, each in zip(times, values, rules, strict=True):
        axis.annotate(f"{each.gap:g}", (time, value), (0, 5), textcoords="offset points", ha="center", fontsize=8)


def _draw_learnt(axis: Axes, scores: DriverScores, name: str, colour: str) -> None:
    found = scores.estimates[name]
    errors = np.transpose([_bars(found)])
    time = scores.estimates["time"].value
    axis.errorbar(time, found.value, yerr=errors, color=colour, marker="D", markersize=4, capsize=2, alpha=0.8)


def _bars(found: Estimate) -> tuple[float, float]:
    """How far its interval reaches below and above the value."""
    low = found.value if found.low is None else found.low
    high = found.value if found.high is None else found.high
    return found.value - low, high - found.value


def film_rules(path: Path, gaps: Sequence[float], seed: int, *, traffic: str, actions: str) -> None:
    """Write a GIF of the rules on one scenario, side by side.

    Args:
        path: the file.
        gaps: of the rules (s).
        seed: of the scenario.
        traffic: flow.
        actions: "discrete" or "continuous".
    """
    settings = {"traffic": traffic, "action_type": actions}
    env = make_render_env(SCENARIO.id, settings)
    adapter = EnvAdapter(make_env(SCENARIO.id, 1, settings))
    clips = []
    for gap in gaps:
        policy = FunctionPolicy(GapDriver(GapRule(gap=gap), actions), adapter)
        caption = f"waits for {gap:g} s" if gap else "goes at once"
        clips.append((caption, list(episode_frames(policy, env, seed, greedy=True))))
    write_gif(clips, path)
