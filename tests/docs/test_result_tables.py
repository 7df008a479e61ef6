"""The tables of results that are written by hand have the numbers of the files next to them."""

from __future__ import annotations

import csv
import io
import re
from functools import cache, partial
from itertools import pairwise, takewhile
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest

import mo_deepdrive
from mo_deepdrive.evaluation.pareto import hypervolume
from mo_deepdrive.evaluation.statistics import mean
from mo_deepdrive.scenarios import SCENARIOS
from tests.helpers.markdown_tables import tables
from tests.helpers.paths import REPOSITORY

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

Row = dict[str, str]
NUMBER = r"(?<![\w.,])-?\d+(?:,\d{3})*(?:\.\d+)?(?:e-\d+)?(?!\w)"

# ------------------------------------------------------------------------------------------------------------ numbers


def printed(cell: str) -> list[str]:
    """The numbers of a cell; in "9 of 10" the first one is a result."""
    return re.findall(NUMBER, re.sub(r" of \d+", "", cell))


def numbers(cell: str, times: float = 1) -> list[float]:
    return [times * float(number.replace(",", "")) for number in printed(cell)]


def agrees(cell: str, expected: list[float]) -> bool:
    """Whether a cell has the expected numbers, rounded to the digits that it prints."""
    texts = printed(cell)
    units = [10.0 ** -len(text.partition(".")[2]) for text in texts]
    return len(texts) == len(expected) and all(
        abs(value - number) <= 0.5 * unit + 1e-9
        for value, number, unit in zip(numbers(cell), expected, units, strict=True)
    )


def changed(cell: str) -> Iterator[str]:
    """The cell with one number changed by two in its last digit, which no rounding hides."""
    cell = re.sub(r" of \d+", "", cell)
    for match in re.finditer(NUMBER, cell):
        last = int(cell[match.end() - 1])
        yield cell[: match.end() - 1] + str(last + (2 if last < 8 else -2)) + cell[match.end() :]


# -------------------------------------------------------------------------------------------------------------- files


@cache
def records(name: str, part: int = 0) -> list[Row]:
    """The rows of a file in docs/results; ``mo-deepdrive table`` writes comparisons below, after an empty line."""
    text = (REPOSITORY / "docs" / "results" / name).read_text(encoding="utf-8")
    return list(csv.DictReader(io.StringIO(text.split("\n\n")[part])))


def matching(name: str, part: int = 0, **values: str) -> list[Row]:
    return [row for row in records(name, part) if all(row[key] == value for key, value in values.items())]


def one(name: str, part: int = 0, **values: str) -> Row:
    found = matching(name, part, **values)
    assert len(found) == 1, f"{name} has {len(found)} rows with {values}"
    return found[0]


def column(rows: Iterable[Row], name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in rows])


def interval(row: Row, name: str, times: float = 1) -> list[float]:
    return [times * float(row[name + end]) for end in ("", "_low", "_high")]


def mean_of(rows: Iterable[Row], name: str) -> list[float]:
    """The mean with the ends of its interval, which is missing where the package prints none."""
    return numbers(mean(column(rows, name)).text())


def median_of(values: np.ndarray) -> list[float]:
    return [float(np.median(values)), float(values.min()), float(values.max())]


# ----------------------------------------------------------------------------------------- from a row to its numbers

IDS = {"OneWaypoint": "one_waypoint", "StaticObstacle": "static_obstacle", "Intersection": "intersection"}


def algorithm(title: str) -> str:
    """MO-PPO is mo_ppo in files."""
    return title.lower().replace("-", "_")


def known_utility(row: Row) -> Row:
    scenario = IDS[row["scenario"]]
    return {
        "environment": f"mo-deepdrive-{scenario.replace('_', '-')}-v0",
        "utility": f"{scenario}_{row['utility'].replace('-', '')}",
        "policy": row["policy"],
    }


def one_vehicle(row: Row) -> dict[str, list[float]]:
    found = one("scores.csv", algorithm=algorithm(row["algorithm"]), **known_utility(row))
    return {
        "utility (ESR)": numbers(found["utility_esr"]),
        "arrivals (%)": numbers(found["success"], 100),
        "collisions (%)": numbers(found["end/collision"], 100),
        "decisions": numbers(found["length"]),
        "mean g": numbers(found["mean_g_force"]),
        "mean jerk": numbers(found["mean_jerk"]),
    }


def one_vehicle_compared(row: Row) -> dict[str, list[float]]:
    found = one("scores.csv", 1, **known_utility(row))
    return {
        "difference": [float(found["value"])],
        "95% interval": [float(found["low"]), float(found["high"])],
        "p": [float(found["p"])],
    }


def of_pairs(name: str, row: Row) -> Callable[[str], Row]:
    """The rows of the vehicles, and that of both under the name "", behind a row of a table of pairs."""
    setting = " end_together=True" if row.get("setting") == "paper" else ""
    values = known_utility({**row, "scenario": "Intersection"})
    values["environment"] += setting
    values["policy"] = values["policy"].replace("sampled", "stochastic")
    return lambda vehicle: one(name, algorithm=algorithm(row["algorithm"]), vehicle=vehicle, **values)


def tuned_pairs(row: Row) -> dict[str, list[float]]:
    found = of_pairs("intersection_tuned.csv", row)
    utilities = {
        "utility of vehicle 0": numbers(found("vehicle_0")["utility_esr"]),
        "of vehicle 1": numbers(found("vehicle_1")["utility_esr"]),
    }
    runs = matching("intersection_runs.csv", **{key: found("")[key] for key in ("utility", "algorithm", "policy")})
    return utilities | counted(runs) if runs else utilities


def counted(runs: list[Row]) -> dict[str, list[float]]:
    """How many pairs solve the intersection, and the ranges over the pairs."""
    success, collisions = column(runs, "success"), column(runs, "collisions")
    return {
        "pairs that solve it": [float(((success >= 0.97) & (collisions <= 0.01)).sum())],
        "both arrive (%)": [100 * success.min(), 100 * success.max()],
        "collisions (%)": [100 * collisions.min(), 100 * collisions.max()],
    }


def ingredients(row: Row) -> dict[str, list[float]]:
    """A number for each seed, and how many of them are at least 90."""
    utility = f"intersection_{row['utility'].replace('-', '')}"
    steps = str(round(1e6 * float(row["million steps"])))
    runs = matching("intersection_ingredients.csv", utility=utility, setting=row["changed"].strip("`"), steps=steps)
    success = 100 * column(runs, "success")
    return {
        "seeds": [float(runs[0]["seed"]), float(runs[-1]["seed"])],
        "both arrive (%), seed by seed": list(success),
        "pairs that turn": [float((success >= 90).sum())],
    }


def earlier_pairs(row: Row) -> dict[str, list[float]]:
    found = of_pairs("intersection_scores.csv", row)
    return {
        "seeds": [float(len(found("")["seeds"].split()))],
        "both arrive (%)": numbers(found("")["success"], 100),
        "vehicle 0 arrives": numbers(found("vehicle_0")["success"], 100),
        "vehicle 1 arrives": numbers(found("vehicle_1")["success"], 100),
        "collisions (%)": numbers(found("")["end/collision"], 100),
    }


def earlier_vehicles(row: Row) -> dict[str, list[float]]:
    found = of_pairs("intersection_scores.csv", row)(f"vehicle_{row['vehicle']}")
    return {
        "utility (ESR)": numbers(found["utility_esr"]),
        "lane-violation return (m)": numbers(found["return/lane_violation"]),
        "decisions": numbers(found["length"]),
        "mean g": numbers(found["mean_g_force"]),
        "mean jerk": numbers(found["mean_jerk"]),
    }


def rules(row: Row) -> dict[str, list[float]]:
    found = one("left_turn_rules.csv", gap=str(float(row["gap (s)"])))
    return {
        **drives(found),
        "near misses (%)": interval(found, "near_miss", 100),
        "left_turn_risk_averse, ESR": interval(found, "left_turn_risk_averse"),
        "the same, SER": interval(found, "left_turn_risk_averse/utility_ser"),
        "left_turn_comfort_budget": interval(found, "left_turn_comfort_budget"),
    }


def drives(found: Row) -> dict[str, list[float]]:
    return {
        "arrivals (%)": interval(found, "arrived", 100),
        "collisions (%)": interval(found, "collision", 100),
        "time (s)": interval(found, "time"),
        "g-force (g)": interval(found, "g_force"),
        "jerk (m/s³)": interval(found, "jerk"),
        "left_turn_linear": interval(found, "left_turn_linear"),
    }


def left_turners(row: Row) -> dict[str, list[float]]:
    if row["driver"].startswith("waits"):
        return drives(one("left_turn_rules.csv", driver=row["driver"]))
    name = algorithm(row["driver"])
    sampled, greedy = (one("left_turn_rules.csv", driver=f"{name}, {policy}") for policy in ("stochastic", "greedy"))
    return {
        **drives(sampled),
        "minus the best rule": interval(sampled, "minus_best_rule"),
        "greedy: minus the best rule": interval(greedy, "minus_best_rule"),
        "greedy: collisions (%)": interval(greedy, "collision", 100),
    }


def left_turn_front(row: Row) -> dict[str, list[float]]:
    names = {"rules": "rules", "PPO": "left_turn_linear-ppo", "MO-PPO": "left_turn_linear-mo_ppo"}
    names |= {"conditioned": "left_turn_front-conditioned_mo_ppo"}
    kind = row["source"].replace(",", "").split()[0]
    found = records("left_turn_front.csv") if kind == "all" else matching("left_turn_front.csv", source=names[kind])
    means = np.array([[float(each[name]) for name in SCENARIOS["left_turn"].objectives] for each in found])
    corner = mo_deepdrive.reference_point("left_turn", gamma=1.0).values
    values = {
        "policies": [len(found)],
        "non-dominated": [column(found, "non_dominated").sum()],
        "hypervolume (10⁹)": [hypervolume(means, corner) / 1e9],
    }
    ranges = {"arrivals (%)": ("arrived", 100), "collisions (%)": ("collision", -100), "time (s)": ("time", -1)}
    ranges |= {"g-force (g)": ("g_force", -1), "jerk (m/s³)": ("jerk", -1)}
    for shown, (name, times) in ranges.items():
        shares = times * column(found, name)
        values[shown] = [] if kind == "all" else [shares.min(), shares.max()]
    return values


def fronts(row: Row) -> dict[str, list[float]]:
    values: dict[str, list[float]] = {}
    environment = "deep-sea-treasure-v0"
    if row["scenario"] in IDS:
        scenario = IDS[row["scenario"]]
        [best] = [
            known
            for known in table_of("docs/fronts.md", "scenario | action_type | gamma | policies")
            if (known["scenario"], known["action_type"], known["gamma"]) == (scenario, row["actions"], "0.99")
        ]
        values = {"best known": numbers(best["hypervolume"])}
        arguments = ["action_type=continuous"] * (row["actions"] == "continuous")
        arguments += ["fixed_destination=True"] + ["fixed_obstacle=True"] * (scenario == "static_obstacle")
        environment = " ".join([f"mo-deepdrive-{scenario.replace('_', '-')}-v0", *arguments])
    title = row["algorithm"]
    if "20 seeds" in title:
        runs = matching("reproduction_scores.csv", task="one_waypoint_front", protocol="best")
        assert len(runs) == 20
        names = {"hypervolume": "hypervolume", "policies": "cardinality", "IGD+": "igd_plus"}
        return values | {shown: mean_of(runs, name) for shown, name in names.items()}
    found = one(
        "front_scores.csv",
        environment=environment,
        algorithm="morl_baselines.pcn" if title.startswith("morl-baselines") else "pcn",
        steps=row["steps"].replace(",", ""),
        seeds="10 11 12" if "3 seeds" in title else "10" if "seed 10" in title else "10 11 12 13 14",
    )
    return values | {
        "hypervolume": numbers(found["hypervolume"]),
        "policies": numbers(found["cardinality"]),
        "IGD+": numbers(found["igd_plus"]),
        "arriving": numbers(found["success"], 100)[:1],
    }


def pairs_apart(row: Row) -> dict[str, list[float]]:
    """Of drivers of one kind with others, one number for each script that a row names."""
    kinds = {"MO-PPO, linear": "mo_ppo_linear_tuned/", "MO-PPO, non-linear": "mo_ppo_nonlinear_tuned/"}
    kinds |= {"vehicles 1 of the linear utility": kinds["MO-PPO, linear"], "the four scripts": "rule:"}
    kinds |= {"vehicles 1 of the non-linear utility": kinds["MO-PPO, non-linear"]}
    firsts = [kinds.get(name, f"rule:{name}") for name in row["vehicle 0"].split("; ")]
    relation = {"its own partner": (True,), "partners of the other seeds": (False,)}.get(row["with"], (True, False))
    others = firsts if len(relation) == 1 else [kinds.get(name, f"rule:{name}") for name in row["with"].split("; ")]
    values: dict[str, list[float]] = {"both arrive (%)": [], "least (%)": [], "collisions (%)": []}
    for first in firsts:
        for other in others:
            met = [
                drive
                for drive in records("cross_play/cross_play.csv")
                if drive["vehicle_0"].startswith(first)
                and drive["vehicle_1"].startswith(other)
                and (drive["vehicle_0"] == drive["vehicle_1"]) in relation
            ]
            values["both arrive (%)"].append(100 * column(met, "success").mean())
            values["least (%)"].append(100 * column(met, "success").min())
            values["collisions (%)"].append(100 * column(met, "end/collision").mean())
    return values


def strangers(vehicle: int, row: Row) -> dict[str, list[float]]:
    """Of one vehicle, a number for each of its seeds."""
    kind = f"strangers_vehicle_{vehicle}" if "others" in next(iter(row.values())) else "mo_ppo_linear_tuned"
    first, last = map(int, row["seeds"].split(" to "))
    name = f"strangers_vehicle_{vehicle}/cross_play.csv"
    met = [matching(name, **{f"vehicle_{vehicle}": f"{kind}/seed{seed}"}) for seed in range(first, last + 1)]
    arrivals = [100 * column(drives, f"vehicle_{vehicle}/success") for drives in met]
    return {
        "arrives (%)": [each.mean() for each in arrivals],
        "collisions (%)": [100 * column(drives, "end/collision").mean() for drives in met],
        "least arrivals with one of them (%)": [each.min() for each in arrivals],
    }


def conditioned(row: Row) -> dict[str, list[float]]:
    runs = matching("conditioned.csv", config=row["config"], changed=row.get("changed", ""))
    values = {"seeds": [float(len(runs))], "steps": [float(runs[0]["steps"])]}
    for shown, name in (("hypervolume", "hypervolume"), ("expected utility", "expected_utility")):
        shares = 100 * column(runs, name)
        values[shown] = [shares.mean(), shares.min(), shares.max()]
    return values | {"CPU seconds": [column(runs, "seconds").mean()]}


def conditioned_targets(row: Row) -> dict[str, list[float]]:
    if row["what"] == "utility of the specialists":
        runs = partial(matching, "conditioned_specialists.csv", config=row["config"], changed="")
        specialist = column(runs(learner="specialist"), "utility").sum()
        networks = runs(learner="network")
        seeds = sorted({each["seed"] for each in networks})
        shares = np.array(
            [column([run for run in networks if run["seed"] == seed], "utility").sum() / specialist for seed in seeds]
        )
    else:
        shares = column(matching("conditioned.csv", config=row["config"], changed=""), row["what"].replace(" ", "_"))
    assert len(shares) == 10
    reached = float((100 * shares >= numbers(row["target"])[0]).sum())
    return {"mean": [100 * shares.mean()], "runs that reach it": [reached]}


def comfort_budgets(row: Row) -> dict[str, list[float]]:
    component = f"budget/{row['budget'].replace('-', '_')}"
    runs = matching("conditioned_preferences.csv", component=component, third=row["third of the budgets"])
    return {
        "spent (discounted)": [-column(runs, "discounted").mean()],
        "arrivals (%)": [100 * column(runs, "arrivals").mean()],
        "decisions": [column(runs, "decisions").mean()],
    }


def pairs_with_preferences(row: Row) -> dict[str, list[float]]:
    run = one(
        "conditioned_preferences.csv",
        environment="mo-deepdrive-intersection-v0",
        component="all",
        seed=row["seed"],
        vehicle=row["vehicle"][0],
    )
    return {
        "own": [float(run["own"])],
        "best": [float(run["best"])],
        "arrivals (%)": [100 * float(run["arrivals"])],
        "decisions": [float(run["decisions"])],
    }


def specialists(config: str, row: Row) -> dict[str, list[float]]:
    weights = next(iter(row.values())).replace(",", "")
    runs = partial(matching, "conditioned_specialists.csv", config=config, changed="", weights=weights)
    networks, [specialist] = runs(learner="network"), runs(learner="specialist")
    assert len(networks) == 10
    return {
        "networks": [column(networks, "utility").mean()],
        "specialist": [float(specialist["utility"])],
        "arrivals (%)": [100 * column(networks, "arrivals").mean()],
        "of the specialist (%)": [100 * float(specialist["arrivals"])],
    }


def representations(row: Row) -> dict[str, list[float]]:
    names = {
        "8 atoms, default bounds": "grid of 8 atoms",
        "8 atoms over all returns": "grid of 8 atoms over the returns",
        "32 particles": "32 particles",
    }
    fits = {
        shown: one(
            "return_representations.csv",
            policy=row["returns of"].strip("`"),
            utility=row["utility"].strip("`"),
            critic=critic,
        )
        for shown, critic in names.items()
    }
    (truth,) = {float(fit["of_returns"]) for fit in fits.values()}
    return {"of the returns": [truth]} | {shown: [float(fit["of_critic"])] for shown, fit in fits.items()}


def esr(row: Row) -> dict[str, list[float]]:
    methods = ("utility_difference", "expected_utility, gamma 1", "expected_utility", "mocac", "ppo")
    learner = next(method for method in methods if method in row["method"].lower().replace("`", ""))
    runs = matching("esr_comparison.csv", task=row["utility"].strip("`"), learner=learner)
    tuned = {run["rate"]: float(run["first"]) for run in runs if run["seed"] == "100"}
    final = sorted((run for run in runs if run["seed"] != "100"), key=lambda run: int(run["seed"]))
    assert {run["rate"] for run in final} == {max(tuned, key=lambda rate: tuned[rate])}
    return {
        "tuning: utility with rates 1, 3, 1/3": [max(tuned[rate], -10_000) for rate in ("1", "3", "0.333")],
        "utility (ESR)": [max(utility, -10_000) for utility in column(final, "first")],
        "arrivals (%)": list(100 * column(final, "second")),
    }


def comfort(row: Row) -> dict[str, list[float]]:
    """A number for each seed; the config stands in the first row of several."""
    table = table_of("docs/results/nonlinear_utilities.md", "config | objective | started by")
    configs = [
        each["config"].split(" (")[0].replace("`", "") for each in table[: table.index(row) + 1] if each["config"]
    ]
    started = row["started by"].split()[0]
    runs = matching(
        "comfort.csv",
        config=f"one_waypoint/{configs[-1]}",
        cost_growth="0.25" if started == "growing" else "0",
        guide="one_waypoint_linear-ppo" if started == "guide" else "",
        policy="stochastic",
    )
    return {"utility (ESR)": list(column(runs, "utility_esr")), "arrivals (%)": list(100 * column(runs, "success"))}


def pcn_elsewhere(row: Row) -> dict[str, list[float]]:
    learner = "pcn" if row["PCN"] == "this package" else "morl_baselines.pcn"
    steps = row["steps"].replace(",", "")
    runs = matching("pcn_comparison.csv", environment=row["environment"], learner=learner, steps=steps)
    return {
        "seeds": [float(len(runs))],
        "hypervolume": mean_of(runs, "hypervolume"),
        "policies": mean_of(runs, "policies"),
        "CPU time": [column(runs, "seconds").mean()],
    }


def peers_compared(task: str, scores: tuple[str, str], times: float, row: Row) -> dict[str, list[float]]:
    """Both scores, the second one ``times`` what the file has; the rate is the one with the best first score."""
    steps = row["steps"].replace(",", "")
    runs = matching("peer_comparison.csv", task=task, learner=row["learner"].strip("`"), steps=steps)
    tuned = {run["rate"]: float(run["first"]) for run in runs if run["seed"] == "100"}
    final = sorted((run for run in runs if run["seed"] != "100"), key=lambda run: int(run["seed"]))
    assert {run["rate"] for run in final} == {max(tuned, key=lambda rate: tuned[rate])}
    assert len(final) == 5
    return {
        "CPU seconds": [column(final, "seconds").mean()],
        "tuning: rates 1, 3, 1/3": [tuned[rate] for rate in ("1", "3", "0.333")],
        scores[0]: mean_of(final, "first"),
        scores[1]: numbers(mean(times * column(final, "second")).text()),
    }


def peers_fronts(row: Row) -> dict[str, list[float]]:
    return peers_compared(f"fixed, {row['actions']}", ("hypervolume", "expected utility"), 1.0, row)


def peers_drawn(row: Row) -> dict[str, list[float]]:
    return peers_compared(f"drawn, {row['actions']}", ("expected utility", "arrivals (%)"), 100.0, row)


def wall_clock(row: Row) -> dict[str, list[float]]:
    driving, cartpole = (
        matching("wall_clock.csv", learner=row["learner"], environment=name)
        for name in ("mo-deepdrive-one-waypoint-v0", "CartPole-v1")
    )
    assert all(run["reached"] == "True" for run in driving)
    speeds = [np.median(column(runs, "steps") / column(runs, "seconds")) for runs in (driving, cartpole)]
    return {
        "CPU seconds to 95% arrivals": median_of(column(driving, "seconds")),
        "steps until then": median_of(column(driving, "steps")),
        "steps/s": [float(f"{speeds[0]:.3g}")],
        "steps/s on CartPole-v1": [float(f"{speeds[1]:.3g}")],
    }


def parity(row: Row) -> dict[str, list[float]]:
    runs = matching("parity.csv", config=row["config"].strip("`"), vehicle=row["vehicle"], code="today")
    today = column(runs, "utility")
    before = [float(runs[0][name]) for name in ("before", "before_low", "before_high")]
    assert row["mean of today"] == (
        "below" if today.mean() < before[1] else "above" if today.mean() > before[2] else "within"
    )
    return {"before": before, "today, seed by seed": list(today)}


def parity_of_the_commit(row: Row) -> dict[str, list[float]]:
    found = {
        code: list(
            column(
                matching("parity.csv", config=row["config"].strip("`"), vehicle=row["vehicle"], code=code), "utility"
            )
        )
        for code in ("before", "today")
    }
    return {"that commit, seed by seed": found["before"], "today, seed by seed": found["today"]}


def training_speeds(row: Row) -> dict[str, list[float]]:
    names = {
        "two A2C learners at the intersection, 128-64": ["two-a2c-128-64"],
        "two MO-PPO learners at the intersection, 128-64": ["two-mo_ppo-128-64"],
        "PCN, collecting alone; with 400 gradient steps per update": ["pcn-collection", "pcn"],
        "train --help": ["train-help"],
        "a whole training run of one update": ["train-one-update"],
    }.get(row["measurement"])
    if names is None:
        title, layers, actions = row["measurement"].split(", ")
        names = [f"{algorithm(title)}-{layers}-{action}" for action in actions.split("; ")]
    found = [one("benchmark_pairs.csv", measurement=name) for name in names]
    return {"speed-up": [float(pair[name]) for pair in found for name in ("speedup", "low", "high")]}


def thread_speeds(row: Row) -> dict[str, list[float]]:
    """Of the layers, which are numbers, too, none is a result."""
    training = row["training"]
    if "/" in training:
        found = one("benchmark_threads_shipped.csv", measurement=training)
    else:
        title, layers = training.split(", ")
        found = one("benchmark_threads.csv", measurement=f"{algorithm(title)}-{layers}-discrete")
    return {
        "one thread, steps/s": [float(found["old"])],
        "two threads, steps/s": [float(found["new"])],
        "speed-up": [float(found[name]) for name in ("speedup", "low", "high")],
    }


def gpu_speeds(row: Row) -> dict[str, list[float]]:
    """Of the layers, which are numbers, too, none is a result."""
    title, layers = row["training"].split(", ")
    found = one("benchmark_gpu.csv", measurement=f"{algorithm(title)}-{layers}-discrete")
    return {
        "one thread, steps/s": [float(found["old"])],
        "GPU, steps/s": [float(found["new"])],
        "speed-up": [float(found[name]) for name in ("speedup", "low", "high")],
    }


def speeds(row: Row) -> dict[str, list[float]]:
    """Of millions of steps to the tenth, otherwise to the nearest thousand; the layers are numbers, too."""

    def rates(*names: str) -> list[float]:
        return [round(float(one("benchmark.csv", measurement=name)["value"]), -3) for name in names]

    learners = ("a2c", "mo_a2c", "mo_ppo")
    if row["what"].startswith("make_vec"):
        scenarios = ("OneWaypoint", "StaticObstacle", "Intersection", "LeftTurn")
        return {"measured": [rate / 1e6 for rate in rates(*(f"{s}, make_vec, N = 1024, 1 thread" for s in scenarios))]}
    if row["what"].startswith("training"):
        alone = rates(*(f"{name} training, 256 x 16, 1 thread" for name in learners))
        two = rates(*(f"independent {name} training, [128, 64], 256 x 16, 1 thread" for name in learners))
        return {"measured": [*alone, 64, 32, *two, 128, 64]}
    return {"measured": rates(*(f"{name}, mo_gymnasium.make" for name in ("OneWaypoint", "LeftTurn", "minecart-v0")))}


# ------------------------------------------------------------------------------------------------------------- tables


class Table(NamedTuple):
    """A table by the beginning of its header, and what its rows should say in some of their columns."""

    document: str
    header: str
    expected: Callable[[Row], dict[str, list[float]]]

    def __str__(self) -> str:
        return f"{self.document}: {self.header}"


TABLES = [
    Table("docs/results/README.md", "scenario | utility | algorithm | policy", one_vehicle),
    Table("docs/results/README.md", "scenario | utility | policy | difference", one_vehicle_compared),
    Table("docs/results/intersection.md", "utility | algorithm | policy | pairs", tuned_pairs),
    Table("docs/results/intersection.md", "utility | changed | million steps", ingredients),
    Table("docs/results/intersection.md", "setting | utility | algorithm | policy | seeds", earlier_pairs),
    Table("docs/results/intersection.md", "setting | utility | algorithm | policy | vehicle", earlier_vehicles),
    Table("docs/results/fronts.md", "scenario | actions | algorithm | steps", fronts),
    Table("docs/results/cross_play.md", "vehicle 0 | with | both arrive", pairs_apart),
    Table("docs/results/cross_play.md", "vehicle 0, with 28 drivers", partial(strangers, 0)),
    Table("docs/results/cross_play.md", "vehicle 1, with 22 drivers", partial(strangers, 1)),
    Table("docs/left_turn.md", "gap (s) | arrivals", rules),
    Table("docs/left_turn.md", "driver | arrivals", left_turners),
    Table("docs/left_turn.md", "source | policies | non-dominated", left_turn_front),
    Table("docs/results/conditioned.md", "config | what | target", conditioned_targets),
    Table("docs/results/conditioned.md", "config | seeds | steps | hypervolume", conditioned),
    Table("docs/results/conditioned.md", "config | changed | seeds", conditioned),
    *(
        Table(
            "docs/results/conditioned.md",
            f"weights: distance, destination, {costs} | networks",
            partial(specialists, config),
        )
        for costs, config in (
            ("g-force, jerk", "one_waypoint/conditioned_drawn"),
            ("g-force, collision, jerk", "static_obstacle/conditioned_drawn"),
            ("g-force, collision, jerk, lane violation, time", "left_turn/conditioned"),
        )
    ),
    Table("docs/results/conditioned.md", "budget | third of the budgets", comfort_budgets),
    Table("docs/results/conditioned.md", "seed | vehicle | own", pairs_with_preferences),
    Table("docs/results/nonlinear_utilities.md", "config | objective | started by", comfort),
    Table("docs/results/nonlinear_utilities.md", "utility | method | tuning", esr),
    Table("docs/learning.md", "returns of | utility", representations),
    Table("docs/peers.md", "environment | steps | reference point | PCN", pcn_elsewhere),
    Table(
        "docs/peers.md",
        "learner | budget | steps | CPU seconds | tuning: rates 1, 3, 1/3 | utility",
        partial(peers_compared, "known utility", ("utility (ESR)", "arrivals (%)"), 100.0),
    ),
    Table(
        "docs/peers.md",
        "actions | learner | budget | steps | CPU seconds | tuning: rates 1, 3, 1/3 | hypervolume",
        peers_fronts,
    ),
    Table(
        "docs/peers.md",
        "actions | learner | budget | steps | CPU seconds | tuning: rates 1, 3, 1/3 | expected utility",
        peers_drawn,
    ),
    Table("docs/benchmark.md", "learner | CPU seconds", wall_clock),
    Table("docs/benchmark.md", "measurement | speed-up", training_speeds),
    Table("docs/benchmark.md", "training | one thread, steps/s | two", thread_speeds),
    Table("docs/benchmark.md", "training | one thread, steps/s | GPU", gpu_speeds),
    Table("docs/results/parity.md", "config | vehicle | before", parity),
    Table("docs/results/parity.md", "config | vehicle | that commit", parity_of_the_commit),
    Table("README.md", "what | measured", speeds),
]


@cache
def table_of(document: str, header: str) -> list[Row]:
    """The rows of the only table with this header; leading empty cells are those of the row above."""
    text = (REPOSITORY / document).read_text(encoding="utf-8")
    found = [rows for rows in tables(text) if " | ".join(rows[0]).startswith(header)]
    assert len(found) == 1, f"{document} has {len(found)} tables with the header {header}"
    [rows] = found
    for above, row in pairwise(rows):
        for name in takewhile(lambda name, row=row: not row[name], row):
            row[name] = above[name]
    return rows


@pytest.mark.parametrize("table", TABLES, ids=str)
def test_a_table_has_the_numbers_of_its_file(table: Table) -> None:
    wrong = []
    for row in table_of(table.document, table.header):
        expected = table.expected(row)
        assert expected
        assert set(expected) <= set(row)
        wrong += [
            f"{list(row.values())[:5]}: {name} is {row[name]!r}, should be {values}"
            for name, values in expected.items()
            if not agrees(row[name], values)
        ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("table", TABLES, ids=str)
def test_a_changed_number_is_noticed(table: Table) -> None:
    """Any of them: by two in its last digit."""
    for row in table_of(table.document, table.header):
        for name, values in table.expected(row).items():
            assert not any(agrees(cell, values) for cell in changed(row[name])), f"{row[name]} of {row}"
