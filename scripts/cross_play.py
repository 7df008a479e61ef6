r"""Cross-play: every driver of vehicle 0 with every driver of the other vehicle, or of all others.

    python scripts/cross_play.py intersection_linear-mo_ppo intersection_linear-ppo --output cross_play
    python scripts/cross_play.py runs/a runs/b --vehicle-0 rule:gap_8 --vehicle-1 rule:straight_6 --output cross_play
    python scripts/cross_play.py runs/a --env mo-deepdrive-roundabout-v0 --vehicles 8 --others rule:drawn_{0..19} ...

    python scripts/cross_play.py --draw docs/results/cross_play

A driver is a run or a policy of the zoo, which drives the vehicles that it learnt to drive; or a rule. At the
intersection rule:gap_3 turns left and waits for a gap of 3 s, rule:straight_6 drives straight on at 6 m/s,
rule:yields_6 also brakes for a vehicle in front of it, each with any number. In a roundabout rule:hurried,
rule:balanced and rule:careful drive any vehicle, rule:enters_3 enters with a gap of 3 s, rule:drawn_7 is the seventh of
the drawn ones that no learner trains with. The folder gets cross_play.csv, and cross_play.png with means over drivers
that differ in their seed alone; --draw draws the picture of a folder again.

    python scripts/cross_play.py RUN --env mo-deepdrive-roundabout-v0 --vehicles 8 --preference hurried time=5 \
      --preference balanced --preference careful near_miss=5 jerk=5 --show vehicle_0/utility_esr --output matrix

RUN of conditioned MO-PPO is one driver for every preference: linear weights in units of its objective_scales, 1 for
objectives that are not named. Each meets every other one.
"""

from __future__ import annotations

import csv
import os
import re
import sys
from collections import Counter
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from algorithms import ConditionedMOPPO
from algorithms.reporting.style import LARGE_DPI, figure_style, save_figure
from algorithms.reporting.tables import print_rows
from algorithms.runs import cli
from algorithms.runs.build import load_policy, open_driver
from algorithms.runs.config import find_environment
from algorithms.runs.console import make_console
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.metrics import COLLISION, SUCCESS, UTILITY_ESR, end_by, return_of, vehicle_name
from mo_deepdrive.evaluation.splits import SPLITS, describe_episodes
from mo_deepdrive.evaluation.statistics import Estimate, mean_or_rate
from mo_deepdrive.evaluation.team import Team
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.world.config import is_ours
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Callable, Mapping, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.policy import Policy

OTHERS = "others"
OWN = "own"
NOTE_AGAIN = "means over the seeds of drivers, and over the episodes of every pair"
CELL = 0.3  # in, side of a cell of the picture
MOST_WITH_NUMBERS = 40  # drivers of a role, above which the cells have no numbers
COLLISIONS = end_by(COLLISION)

# ------------------------------------------------------------------------------------------------------------- drivers


def open_drivers(options: Namespace, env: EnvAdapter) -> list[dict[str, Policy]]:
    """The drivers of each role by name; the folder that all runs are in is left out of the names."""
    runs = {name: Run.open(name, trust=options.trust) for name in options.runs}
    learnt = {name: set(run.experiment.training.partners) for name, run in runs.items()}
    given = [options.vehicle_0, options.vehicle_1]
    folders = [Path(name).absolute() for name in (*runs, *given[0], *given[1]) if Path(name).is_dir()]
    shared = os.path.commonpath([folder.parent for folder in folders]) if folders else ""
    drivers = []
    for role, others, seats in zip(roles_of(env.vehicles), given, ([0], range(1, env.vehicles)), strict=True):
        names = [name for name in options.runs if not learnt[name] & {vehicle_name(v) for v in seats}] + others
        if not names:
            raise ValueError(f"{role} has no driver")
        opened: dict[str, Policy] = {}
        for name in names:
            shown = os.path.relpath(name, shared) if Path(name).is_dir() else name
            if shown in opened:
                raise ValueError(f"{role} has two drivers {shown!r}; the second is {name!r}")
            if not shown.isprintable():
                raise ValueError(f"driver {shown!r} has characters in its name that cannot be printed")
            if options.preference and name in runs and not runs[name].experiment.known_utility:
                opened |= conditioned_drivers(runs[name], options.preference)
                continue
            for v in seats:
                opened[shown] = open_driver(name, v, env, "discrete", trust=options.trust)
        drivers.append(opened)
    return drivers


def conditioned_drivers(run: Run, preferences: Sequence[Sequence[str]]) -> dict[str, Policy]:
    """The drivers of a run of conditioned MO-PPO by the names of their preferences."""
    agent = load_policy(run)
    if not isinstance(agent, ConditionedMOPPO):
        raise ValueError(f"{run.path} has no preferences; --preference needs a run of conditioned MO-PPO")
    weights = weights_of(preferences, agent.env.objectives)
    rows = {name: agent.preferences.condition("linear", numbers) for name, numbers in weights.items()}
    return {name: agent.policy(np.tile(row, agent.env.vehicles)) for name, row in rows.items()}


def weights_of(preferences: Sequence[Sequence[str]], objectives: Sequence[str]) -> dict[str, dict[str, float]]:
    """The weights of every objective, 1 if they are not given, by the name of the preference, which comes first."""
    return {
        name: dict.fromkeys(objectives, 1.0) | cli.named_numbers(f"--preference {name}", pairs, objectives)
        for name, *pairs in preferences
    }


def utilities_of(options: Namespace, env: EnvAdapter, drivers: list[dict[str, Policy]]) -> Any:
    """The utility by which all are judged, or by name those of the preferences."""
    made: Any = env.vector_env.unwrapped
    if options.utility != OWN:
        return options.utility or f"{made.config.scenario}_linear"
    policies: dict[str, Any] = drivers[0] | drivers[1]
    preferences, utilities = weights_of(options.preference, env.objectives), {}
    for name, policy in policies.items():
        if name not in preferences:
            raise ValueError(f"--utility {OWN}: {name!r} has no preference")
        weights = np.array([preferences[name][objective] for objective in env.objectives])
        scaled = weights / policy.agent.scales / weights.sum()
        utilities[name] = make_utility("linear", env.objectives, weights=scaled.tolist())
    return utilities


# ---------------------------------------------------------------------------------------------------------- encounters


def roles_of(vehicles: int) -> tuple[str, str]:
    """The two roles: vehicle 0, and vehicle 1 or, if there are more, all others."""
    return vehicle_name(0), vehicle_name(1) if vehicles == 2 else OTHERS


@dataclass(frozen=True)
class Encounter:
    """What the driver of vehicle 0 and that of all others achieve together."""

    drivers: tuple[str, str]
    roles: tuple[str, str]
    #: What is measured of all vehicles together, such as "success"; arrivals and utility of both roles, such as
    #: "vehicle_0/success", which for several others are means over them; and the returns of vehicle 0.
    estimates: dict[str, Estimate]


def cross_play(
    drivers: Sequence[Mapping[str, Policy]],
    env_id: str,
    utility: Any,
    progress: Callable[[], None] = lambda: None,
    **evaluation: Any,
) -> list[Encounter]:
    """Let every driver of vehicle 0 drive with every driver of all other vehicles, on the same scenarios.

    The utility judges all vehicles, or those of each driver, by its name; ``evaluation`` are further arguments of
    :func:`mo_deepdrive.evaluation.evaluate`. The encounters of the first driver of vehicle 0 come first.
    """
    encounters = []
    for (first, one), (second, other) in product(drivers[0].items(), drivers[1].items()):
        others = one.env.vehicles - 1
        judges = [utility[name] if isinstance(utility, dict) else utility for name in (first, second)]
        team = Team([one, other], [0] + [1] * others)
        result = evaluate(team, env_id, utility=judges[:1] + judges[1:] * others, **evaluation)
        encounters.append(Encounter((first, second), roles_of(others + 1), estimates_of(result)))
        progress()
    return encounters


def estimates_of(result: Evaluation) -> dict[str, Estimate]:
    """The scores of an encounter with their intervals over the episodes."""
    vehicles = result.returns.shape[1]
    samples = result.team_samples()
    utilities = np.stack([result.episode_utilities(v) for v in range(vehicles)], axis=1)
    for name, scores in ((SUCCESS, result.succeeded), (UTILITY_ESR, utilities)):
        for role, part in zip(roles_of(vehicles), (scores[:, :1], scores[:, 1:]), strict=True):
            samples[f"{role}/{name}"] = part[:, 0] if part.shape[1] == 1 else part.mean(axis=1)
    for i, objective in enumerate(result.objectives):
        samples[f"{vehicle_name(0)}/{return_of(objective)}"] = result.returns[:, 0, i]
    return {name: mean_or_rate(values) for name, values in samples.items()}


# ------------------------------------------------------------------------------------------------------------- results


def drivers_of(encounters: Sequence[Encounter], role: int) -> list[str]:
    """The drivers of vehicle 0 (role 0) or of the others (1), in the order of the encounters."""
    return list(dict.fromkeys(encounter.drivers[role] for encounter in encounters))


def matrix(encounters: Sequence[Encounter], score: str) -> NDArray[np.float64]:
    """(K, L) values of a score, of K drivers of vehicle 0 with L drivers of the others."""
    values = [encounter.estimates[score].value for encounter in encounters]
    return np.array(values).reshape(len(drivers_of(encounters, 0)), -1)


def write_encounters(path: Path, encounters: Sequence[Encounter]) -> None:
    """Write a CSV with a row per encounter: each score and the ends of its interval."""
    ends = ("", "/low", "/high")
    rows = [[*encounters[0].roles, *(name + end for name in encounters[0].estimates for end in ends)]]
    for encounter in encounters:
        numbers = [n for score in encounter.estimates.values() for n in (score.value, score.low, score.high)]
        rows.append([*encounter.drivers, *("" if number is None else f"{number:.5g}" for number in numbers)])
    atomic_write(path, csv_bytes(rows))


def summary_rows(encounters: Sequence[Encounter], role: int) -> list[list[str]]:
    """A table, header first: means of each driver over those it met, and the one with which it arrives least."""
    name = encounters[0].roles[role]
    scores = [matrix(encounters, score) for score in (f"{name}/{SUCCESS}", COLLISIONS, f"{name}/{UTILITY_ESR}")]
    arrivals, collisions, utility = (values.T if role else values for values in scores)
    met = drivers_of(encounters, 1 - role)
    rows = [[name, "met", "arrives (%)", "collisions (%)", "utility", "least with", "arrives (%)"]]
    for k, driver in enumerate(drivers_of(encounters, role)):
        means = [f"{100 * arrivals[k].mean():.1f}", f"{100 * collisions[k].mean():.1f}", f"{utility[k].mean():.2f}"]
        worst = int(arrivals[k].argmin())
        rows.append([driver, str(len(met)), *means, met[worst], f"{100 * arrivals[k, worst]:.1f}"])
    return rows


def matrix_rows(encounters: Sequence[Encounter], score: str) -> list[list[str]]:
    """A score as a table as text, header first: a row per driver of vehicle 0, a column per driver of the others."""
    header = [score, *(f"among {name}" for name in drivers_of(encounters, 1))]
    names, values = drivers_of(encounters, 0), matrix(encounters, score)
    return [header, *([name, *(f"{value:.4g}" for value in row)] for name, row in zip(names, values, strict=True))]


def read_encounters(path: Path) -> list[Encounter]:
    """The encounters of a CSV of :func:`write_encounters`."""
    with path.open(encoding="utf-8") as stream:
        table = csv.DictReader(stream)
        first, second, *columns = table.fieldnames or ["", ""]
        numbers = [({name: float(row[name]) if row[name] else None for name in columns}, row) for row in table]
    scores = [name for name in columns if not name.endswith(("/low", "/high"))]
    return [
        Encounter(
            (row[first], row[second]),
            (first, second),
            {name: Estimate(each[name] or 0.0, each[f"{name}/low"], each[f"{name}/high"]) for name in scores},
        )
        for each, row in numbers
    ]


def kinds_of(names: Sequence[str]) -> list[str]:
    """For each driver its name without the seed, and how many there are of them."""
    plain = [re.sub(r"[-/_]?seed_?\d+$", "", name) or name for name in names]
    counts = Counter(plain)
    return [f"{name} ({counts[name]} seeds)" if counts[name] > 1 else name for name in plain]


def by_kind(values: NDArray[np.float64], rows: Sequence[str], columns: Sequence[str]) -> NDArray[np.float64]:
    """Means of values (K, L) over the rows, and over the columns, of one kind, in their order."""
    for axis, kinds in ((0, rows), (1, columns)):
        parts = [[k for k, name in enumerate(kinds) if name == kind] for kind in dict.fromkeys(kinds)]
        values = np.stack([values.take(part, axis).mean(axis) for part in parts], axis)
    return values


def plot_encounters(path: Path, encounters: Sequence[Encounter], note: str) -> None:
    """Draw the matrices of joint arrivals, collisions and utilities; the note says what was evaluated."""
    kinds = [kinds_of(drivers_of(encounters, role)) for role in (0, 1)]
    (rows, columns), roles = ([*dict.fromkeys(each)] for each in kinds), encounters[0].roles
    names = ["the others" if role == OTHERS else role.replace("_", " ") for role in roles]
    panels = [  # score, title, colour map, and whether the cells are percentages
        (SUCCESS, f"{'all' if OTHERS in roles else 'both'} arrive (%)", "Blues", True),
        (COLLISIONS, "collisions (%)", "OrRd", True),
        *((f"{r}/{UTILITY_ESR}", f"utility of {name}", "Purples", False) for r, name in zip(roles, names, strict=True)),
    ]
    letters = 0.085 * max(map(len, [*rows, *columns]))
    size = 2 * (CELL * len(columns) + letters + 1.1), 2 * (CELL * len(rows) + letters + 0.7) + 0.6
    with figure_style():
        figure = Figure(figsize=(max(size[0], 8.0), max(size[1], 5.0)), layout="constrained")
        figure.suptitle(f"Cross-play\n{note}", fontsize=11, ha="left", x=0.02, parse_math=False)
        for axis, (score, title, colours, percent) in zip(figure.subplots(2, 2).flat, panels, strict=True):
            values = by_kind(matrix(encounters, score), *kinds) * (100.0 if percent else 1.0)
            _draw(axis, values, colours, (0.0, 100.0) if percent else (float(values.min()), float(values.max())))
            axis.set_title(title)
            axis.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8, parse_math=False)
            axis.set_yticks(range(len(rows)), rows, fontsize=8, parse_math=False)
            axis.set_xlabel(f"driver of {names[1]}")
            axis.set_ylabel(f"driver of {names[0]}")
        save_figure(figure, path, LARGE_DPI)


def _draw(axis: Axes, values: NDArray[np.float64], colours: str, limits: tuple[float, float]) -> None:
    axis.imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1], aspect="equal")
    axis.grid(visible=False)
    dark = limits[0] + 0.6 * (limits[1] - limits[0])
    for (row, column), value in np.ndenumerate(values) if max(values.shape) <= MOST_WITH_NUMBERS else ():
        text = f"{value:.0f}" if limits == (0.0, 100.0) else f"{value:.1f}".rstrip("0").rstrip(".")
        axis.text(column, row, text, ha="center", va="center", fontsize=6.5, color="white" if value > dark else "black")


# -------------------------------------------------------------------------------------------------------- command line


def play(options: Namespace) -> int:
    """Let all drivers meet, and write and print what they achieve."""
    if options.draw:
        plot_encounters(options.draw / "cross_play.png", read_encounters(options.draw / "cross_play.csv"), NOTE_AGAIN)
        print(f"written: {options.draw / 'cross_play.png'}")
        return 0
    if options.output is None:
        raise ValueError("--output is needed")
    cli.check_directory("--output", options.output)
    arguments = {} if options.vehicles is None else {"vehicles": options.vehicles}
    if not is_ours(find_environment(options.env, "--env")):
        raise ValueError(f"--env = {options.env!r}: only this package's environments have several vehicles")
    env = EnvAdapter(make_env(options.env, 1, arguments))
    if env.vehicles == 1:
        raise ValueError(f"--env {options.env} has one vehicle; cross-play needs several")
    drivers = open_drivers(options, env)
    utility = utilities_of(options, env, drivers)
    pairs, done = len(drivers[0]) * len(drivers[1]), 0
    with make_console().status("") as status:

        def progress() -> None:
            nonlocal done
            done += 1
            status.update(f"{done} of {pairs} pairs")

        how = {name: getattr(options, name) for name in ("split", "episodes", "greedy")}
        encounters = cross_play(drivers, options.env, utility, progress, env_kwargs=arguments, **how)
    episodes = describe_episodes(options.episodes, SPLITS[options.split].start)
    name = OWN if isinstance(utility, dict) else utility
    note = f"{episodes} per pair, {'greedy' if options.greedy else 'sampled'} actions, utility {name}"
    options.output.mkdir(parents=True, exist_ok=True)
    write_encounters(options.output / "cross_play.csv", encounters)
    plot_encounters(options.output / "cross_play.png", encounters, note)
    for k, role in enumerate(encounters[0].roles):
        print_rows(Console(), summary_rows(encounters, k), f"{role} with those that it met: {note}", 1)
    for score in options.show:
        print_rows(Console(), matrix_rows(encounters, score), "", 1)
    print(f"written: {options.output / 'cross_play.csv'}, {options.output / 'cross_play.png'}")
    return 0


INTERSECTION = SCENARIOS["intersection"].id
UTILITY = f"of all (default: the linear one of the scenario); {OWN!r} for the preference of each"
PREFERENCE = "a driver of each RUN of conditioned MO-PPO: its name, and weights"
OPTIONS = (
    cli.option("runs", "RUN", "drivers of every vehicle that they learnt to drive", nargs="*"),
    cli.option("--vehicle-0", "DRIVER", "drivers of vehicle 0 alone", nargs="+", default=[]),
    cli.option("--vehicle-1", "DRIVER", "drivers of vehicle 1 alone", nargs="+", default=[]),
    cli.option("--others", "DRIVER", "drivers of all vehicles but 0", nargs="+", default=[], dest="vehicle_1"),
    cli.option("--env", "ID", "environment of several vehicles (default: %(default)s)", default=INTERSECTION),
    cli.option("--vehicles", "V", "argument of the environment", type=int),
    cli.option("--preference", "NAME", PREFERENCE, nargs="+", action="append", default=[]),
    cli.option("--output", "DIR", "folder of the table and the picture", type=Path),
    cli.option("--draw", "DIR", "draw the picture of the table in this folder again", type=Path),
    cli.option("--episodes", "N", "per pair (default: %(default)s)", type=int, default=200),
    cli.option("--split", None, "scenario seeds (default: %(default)s)", choices=SPLITS, default="test"),
    cli.option("--utility", "NAME", UTILITY),
    cli.option("--show", "SCORE", "print the matrix of a column of the CSV", nargs="+", default=[]),
    cli.flag("--greedy", "the most likely actions instead of sampled ones"),
    cli.TRUST,
)
main = cli.Command("", __doc__, OPTIONS, play)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
