"""Build what the page ships with: worlds as WebAssembly, policies of the zoo, and what others have earned there.

    python scripts/page_data.py                  # everything; needs wasm-ld
    python scripts/page_data.py --keep-modules   # all but the compiled worlds

Run it when the simulator, a scenario or an offered policy changes; tests say when that is. :mod:`algorithms.runs.web`
describes the files.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import moocore
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from algorithms.driving.intersection_rules import make_rule as intersection_rule
from algorithms.driving.left_turn_rules import GapDriver, GapRule
from algorithms.driving.roundabout_rules import make_rule as roundabout_rule
from algorithms.reporting.page.data import explorable_best_known, rounded
from algorithms.reporting.page.page import WORLDS as FOLDER
from algorithms.reporting.page.page import write_fronts
from algorithms.runs import web
from algorithms.runs.build import load_policy
from algorithms.runs.run_directory import Run
from mo_deepdrive.device.wasm import compile_module
from mo_deepdrive.evaluation import elicitation
from mo_deepdrive.simulation.state import ENDS
from mo_deepdrive.suite.plans import planned_actions
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.world.action_sequences import encode

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from mo_deepdrive.world.config import EnvConfig

CONDITIONED = "MO-PPO that follows a preference"
PREFERENCES = 12  # under which a conditioned policy drives for comparison
EXPLORED = ("one_waypoint_discrete", "static_obstacle_discrete")
Act = "Callable[..., NDArray[Any]]"


class World(NamedTuple):
    """What the page offers in a scenario."""

    name: str
    id: str
    utility: str
    policies: tuple[tuple[str, str], ...] = ()  # names in the zoo, and labels
    rules: tuple[tuple[str, Any], ...] = ()  # labels, and a maker of each
    plans: str = ""  # the task of the suite whose planned drives are the best known ones
    arguments: dict[str, Any] = {}


def _for_all(make: Callable[..., Any], name: str) -> Any:
    return partial(make, f"rule:{name}", "discrete")


ROUNDABOUT_RULES = tuple(
    (f"the {name} rule", _for_all(roundabout_rule, name)) for name in ("hurried", "balanced", "careful")
)
OFFERED = (
    World(
        "left_turn",
        "mo-deepdrive-left-turn-v1",
        "left_turn_linear",
        (("left_turn_front-conditioned_mo_ppo", CONDITIONED), ("suite_k5-ppo", "PPO in a hurry")),
        tuple(
            (f"the rule that waits for a gap of {gap} s", partial(lambda s: GapDriver(GapRule(gap=s)), gap))
            for gap in (3, 5)
        ),
    ),
    World(
        "static_obstacle",
        "mo-deepdrive-static-obstacle-v1",
        "static_obstacle_linear",
        (("suite_k1-mo_ppo", "MO-PPO"), ("suite_k3-mo_ppo", "MO-PPO on a tight budget of comfort")),
        plans="K1",
    ),
    World(
        "one_waypoint",
        "mo-deepdrive-one-waypoint-v1",
        "one_waypoint_linear",
        (
            ("one_waypoint_drawn_front-conditioned_mo_ppo", CONDITIONED),
            ("suite_k4-mo_ppo_esr", "MO-PPO for an arrival within limits"),
        ),
        plans="K4",
    ),
    World(
        "intersection",
        "mo-deepdrive-intersection-v1",
        "intersection_hurried",
        (("suite_v1-mo_ppo-strangers", "MO-PPO that learnt among strangers"),),
        (("the rule that waits for a gap of 3 s", _for_all(intersection_rule, "gap_3")),),
    ),
    World(
        "roundabout",
        "mo-deepdrive-roundabout-v0",
        "roundabout_linear",
        (("roundabout_front-conditioned_mo_ppo", CONDITIONED),),
        ROUNDABOUT_RULES,
        arguments={"vehicles": 8},
    ),
    World("roundabout_solo", "mo-deepdrive-roundabout-solo-v0", "roundabout_linear", (), ROUNDABOUT_RULES),
)


def of_rule(make: Callable[[], Any], vehicles: int) -> Any:
    """A rule as what drives: those vehicles that it can, while others drive straight on at 5 m/s, or idle."""
    rule = make()
    straight = intersection_rule("rule:straight_5", "discrete") if rule.vehicle == 0 and vehicles > 1 else None

    def act(observations: NDArray[Any], rewards: NDArray[Any], t: int) -> NDArray[Any]:
        actions = np.zeros(observations.shape[:2], dtype=np.int64)
        if vehicles == 1 or straight is not None:
            accrued = rewards[:, 0] if t else np.zeros_like(rewards[:, 0])
            actions[:, 0] = rule(observations[:, 0], accrued, np.ones(len(observations)))
        else:
            actions[:] = rule(observations)
        if straight is not None:
            actions[:, 1] = straight(observations[:, 1])
        return actions

    return act


def of_agent(agent: Any, objectives: list[str], weights: NDArray[Any] | None = None) -> Any:
    """The greedy policy of an agent, under weights (d,) of its own objectives if it follows some."""
    columns = [objectives.index(name) for name in agent.env.objectives]
    actors = {v: learner.actor for learner in agent.learners for v in learner.vehicles}
    past: dict[str, Any] = {}

    @torch.no_grad()
    def act(observations: NDArray[Any], rewards: NDArray[Any], t: int) -> NDArray[Any]:
        if t == 0:
            past["accrued"], past["discount"] = torch.zeros(*rewards.shape[:2], len(columns)), 1.0
        else:
            past["accrued"] = past["accrued"] + past["discount"] * torch.from_numpy(rewards[..., columns])
            past["discount"] *= float(agent.accrued_discount)
        actions = np.zeros(observations.shape[:2], dtype=np.int64)
        for v, actor in actors.items():
            seen, discounts = torch.from_numpy(observations[:, v]), torch.full((len(observations),), past["discount"])
            asked = None if weights is None else (torch.tensor(weights).float().expand(len(seen), -1), agent.ideal[0])
            outputs = actor.body(agent.inputs(seen, past["accrued"][:, v], discounts, asked))
            actions[:, v] = actor.best(outputs).numpy()
        return actions

    return act


def replayed(sequences: list[NDArray[Any]]) -> Any:
    """What drives every episode by its own actions (n,), and idles after them."""
    longest = np.zeros((max(map(len, sequences)) + 1, len(sequences), 1), dtype=np.int64)
    for row, sequence in enumerate(sequences):
        longest[: len(sequence), row, 0] = sequence
    return lambda _seen, _rewards, t: longest[min(t, len(longest) - 1)]


def facts_of(world: World, config: EnvConfig) -> dict[str, Any]:
    """NAME.json of a world, with its policies written."""
    facts = web.world_facts(config, world.id, world.arguments)
    objectives = [objective["key"] for objective in facts["objectives"]]
    seeds, scales = facts["seeds"], np.array([objective["scale"] for objective in facts["objectives"]])
    drivers: dict[str, Any] = {label: of_rule(make, facts["vehicles"]) for label, make in world.rules}
    front: dict[str, NDArray[Any]] = {}
    for name, label in world.policies:
        agent = load_policy(Run.open(name))
        rows = web.write_policies(Path(str(FOLDER)), agent, name, label)
        facts["policies"] += rows
        if not rows[0]["conditioned"]:
            drivers[label] = of_agent(agent, objectives)
            continue
        d = len(agent.env.objectives)
        asked = np.random.default_rng(0).dirichlet(np.ones(d), PREFERENCES)
        asked[:d] = 0.5 / d + 0.5 * np.eye(d)[:PREFERENCES]  # one for each objective first
        driven = [web.drive(config, seeds, of_agent(agent, objectives, weights)) for weights in asked]
        front |= {f"preference {k + 1} of {CONDITIONED}": drives.returns[:, 0] for k, drives in enumerate(driven)}
        facts["questions"] = questions(driven, seeds[0], scales)
    if world.plans:
        plans = [planned_actions(world.plans, k)[0] for k in range(len(seeds))]
        drivers["the best known drive"] = replayed(plans)
        facts["ghost"] = [encode(plan) for plan in plans]
    for label, act in drivers.items():
        drives = web.drive(config, seeds, act)
        front[label] = drives.returns[:, 0]
        facts["drivers"].append(
            {
                **{"name": label, "label": label, "returns": rounded(drives.returns[:, 0])},
                "ends": [ENDS[end] for end in drives.ends[:, 0]],
            }
        )
    if front:
        means = np.array([returns.mean(axis=0) for returns in front.values()])
        kept = np.flatnonzero(moocore.is_nondominated(means, maximise=True))
        facts["front"] = [{"name": [*front][k], "returns": rounded(means[k])} for k in kept]
    weights = make_utility(world.utility, objectives).weights
    facts["utilities"] = [{"name": world.utility, "label": world.utility.replace("_", " "), "weights": weights}]
    return facts


def questions(driven: list[web.Drives], seed: int, scales: NDArray[Any]) -> dict[str, Any]:
    """Drives of the first seed that differ, between which a person is asked to choose."""
    kept: dict[bytes, int] = {}
    for k, drives in enumerate(driven):
        kept.setdefault(drives.returns[0, 0].tobytes(), k)
    returns = np.array([driven[k].returns[0, 0] for k in kept.values()])
    return {
        **elicitation.question_tree(returns / scales),
        "drives": [
            {
                **{"name": f"preference {k + 1}", "label": f"preference {k + 1}", "seed": seed},
                "actions": [
                    encode(driven[k].actions[: driven[k].lengths[0, v], 0, v])
                    for v in range(driven[k].lengths.shape[1])
                ],
                "returns": row,
            }
            for k, row in zip(kept.values(), rounded(returns, 9), strict=True)
        ],
    }


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep-modules", action="store_true", help="keep the compiled worlds that are there")
    options, folder, rows = parser.parse_args(), Path(str(FOLDER)), []
    folder.mkdir(exist_ok=True)
    for world in OFFERED:
        config = web.configuration("world", world.id, world.arguments)
        file = folder / f"{world.name}.wasm"
        module = file.read_bytes() if options.keep_modules else compile_module(config)
        rows.append(web.write_world(folder, world.name, facts_of(world, config), module))
        print(f"{world.name}: {rows[-1]['bytes'] / 1000:.0f} kB", flush=True)
        web.write_page_list(folder, rows)
    write_fronts(folder / "explorer.json", [explorable_best_known(name) for name in EXPLORED])


if __name__ == "__main__":
    main()
