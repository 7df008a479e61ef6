"""What the fixed rules for LeftTurn achieve: a table and a picture, from fast and risky to slow and safe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from algorithms.common.atomic_io import atomic_write, csv_bytes
from algorithms.common.env_adapter import EnvAdapter, make_env
from algorithms.evaluation.episodes import evaluate
from algorithms.evaluation.function_policy import FunctionPolicy
from algorithms.evaluation.metrics import COLLISION, UTILITY_SER
from algorithms.evaluation.statistics import Estimate, mean, rate, utility_of_mean
from algorithms.planning.left_turn_rules import SCENARIO, GapDriver, GapRule
from algorithms.reporting.animated_gif import write_gif
from algorithms.reporting.style import DPI, STYLE, surround
from algorithms.reporting.videos import episode_frames, make_render_env
from mo_deepdrive.utilities import make_utility

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from algorithms.evaluation.episodes import Evaluation
    from algorithms.evaluation.splits import Split

RISK_AVERSE = "left_turn_risk_averse"
# Of the table, in order. Time and comfort are those of the episodes that arrive: a collision ends an episode early.
SHARES = ("arrived", "collision", "near_miss")
AMOUNTS = ("time", "g_force", "jerk", "lane_violation")
UTILITIES = ("left_turn_linear", "left_turn_comfort_budget", RISK_AVERSE)


@dataclass(frozen=True)
class RuleScores:
    """Scores of one rule, by name.

    Attributes:
        gap: the gap for which it waits (s).
        episodes: of the evaluation.
        estimates: every score with its 95% interval over the episodes.
    """

    gap: float
    episodes: int
    estimates: dict[str, Estimate]


def score_rules(
    gaps: Iterable[float], *, episodes: int, split: Split = "test", traffic: str = "default", actions: str = "discrete"
) -> list[RuleScores]:
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
    arguments = {"traffic": traffic, "action_type": actions, "objectives": [*SCENARIO.objectives, "near_miss"]}
    return [
        RuleScores(
            rule.gap,
            episodes,
            _estimates(
                evaluate(GapDriver(rule, actions), SCENARIO.id, split=split, episodes=episodes, env_kwargs=arguments)
            ),
        )
        for rule in rules
    ]


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


def rows(scores: Sequence[RuleScores]) -> list[list[str]]:
    """The table as text, header first."""
    names = list(scores[0].estimates)
    body = [[f"{each.gap:g}", *(each.estimates[name].text() for name in names)] for each in scores]
    return [["gap (s)", *names], *body]


def write_scores(path: Path, scores: Sequence[RuleScores]) -> None:
    """Write a CSV with a row per rule, and of every score its value and both ends of its interval.

    Raises:
        OSError: if the file cannot be written; it is complete or unchanged.
    """
    names = list(scores[0].estimates)
    header = ["gap", "episodes", *(f"{name}{end}" for name in names for end in ("", "_low", "_high"))]
    body = [
        [
            each.gap,
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


def plot_scores(path: Path, scores: Sequence[RuleScores], note: str) -> None:
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
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(13.5, 3.3))
        axes = figure.subplots(1, len(panels))
        for axis, (title, lines) in zip(axes, panels, strict=True):
            axis.set_title(title)
            axis.set_xlabel("time of an arrival (s)")
            for name, label, colour in lines:
                _draw(axis, scores, name, label, colour)
            axis.margins(0.12)
        handles = [
            Line2D([], [], color=colour, marker="o", label=label)
            for _, lines in panels[:1]
            for _, label, colour in lines
        ]
        notes = [note, "numbers: the gap in seconds for which the rule waits; bars: 95% intervals over the episodes"]
        surround(figure, "LeftTurn: what fixed rules achieve", notes, handles)
        figure.savefig(path, dpi=DPI)


def _draw(axis: Axes, scores: Sequence[RuleScores], name: str, label: str, colour: str) -> None:
    times = [each.estimates["time"].value for each in scores]
    found = [each.estimates[name] for each in scores]
    values = np.array([each.value for each in found])
    ends = np.array(
        [
            (each.value if each.low is None else each.low, each.value if each.high is None else each.high)
            for each in found
        ]
    )
    errors = np.abs(ends.T - values)
    axis.errorbar(times, values, yerr=errors, color=colour, marker="o", markersize=4, capsize=2, label=label)
    for time, value, each in zip(times, values, scores, strict=True):
        axis.annotate(f"{each.gap:g}", (time, value), (0, 5), textcoords="offset points", ha="center", fontsize=8)


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
