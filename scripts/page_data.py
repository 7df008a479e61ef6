"""Build what the page ships with: worlds as WebAssembly, policies of the zoo, and what others have earned there.

    python scripts/page_data.py                  # everything; needs wasm-ld
    python scripts/page_data.py --keep-modules   # all but the compiled worlds

Run it when the simulator, a scenario or an offered policy changes; tests say when. ``page_worlds.yaml`` says what
the page offers, and :mod:`algorithms.runs.web` describes the files.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import moocore
import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from algorithms.driving.left_turn_rules import GapDriver, GapRule
from algorithms.driving.roundabout_rules import make_rule
from algorithms.reporting.page.data import explorable_best_known, rounded
from algorithms.reporting.page.page import WORLDS, write_fronts
from algorithms.runs import web
from algorithms.runs.build import load_policy
from algorithms.runs.run_directory import Run
from mo_deepdrive.device.wasm import compile_module
from mo_deepdrive.evaluation.elicitation import question_tree
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.simulation.state import ENDS
from mo_deepdrive.suite.plans import planned_actions
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.world.action_sequences import encode

if TYPE_CHECKING:
    from mo_deepdrive.world.config import EnvConfig

FOLDER, OFFERED = Path(str(WORLDS)), yaml.safe_load(Path(__file__).with_name("page_worlds.yaml").read_text())
PREFERENCES = 12  # under which a conditioned policy drives for comparison


def by_rule(rule: float | str) -> Any:
    """A scripted driver as what :func:`algorithms.runs.web.drive` asks."""
    if isinstance(rule, str):
        driver = make_rule(f"rule:{rule}", "discrete")
        return lambda seen, _past: driver(seen)
    gap = GapDriver(GapRule(gap=rule))
    return lambda seen, past: gap(seen[:, 0], past.value[:, 0], past.discounts)[:, None]


def by_policy(policy: Any, own: tuple[str, ...], objectives: list[str]) -> Any:
    """A policy that learnt with ``own`` objectives, which are among those of the world, likewise."""
    columns = [objectives.index(name) for name in own]

    def act(seen: Any, past: AccruedReward) -> Any:
        return policy.act(seen, AccruedReward(past.value[..., columns], past.discounts, past.decisions), None)

    return act


def preferences(d: int) -> np.ndarray:
    """Weights (PREFERENCES, d): first those that favour one objective."""
    drawn = np.random.default_rng(0).dirichlet(np.ones(d), PREFERENCES)
    drawn[:d] = 0.5 / d + 0.5 * np.eye(d)[:PREFERENCES]
    return drawn


def facts_of(world: dict[str, Any], config: EnvConfig) -> dict[str, Any]:
    """NAME.json of a world, with its policies written."""
    facts = web.world_facts(config, world["id"], world.get("arguments", {}))
    objectives, seeds = [objective["key"] for objective in facts["objectives"]], facts["seeds"]
    drives: dict[str, web.Drives] = {}
    for label, rule in world.get("rules", {}).items():
        drives[label] = web.drive(config, seeds, by_rule(rule))
    asked: list[web.Drives] = []
    for name, label in world.get("policies", {}).items():
        agent = load_policy(Run.open(name))
        gamma, own = float(agent.accrued_discount), agent.env.objectives
        if label != "preference":
            facts["policies"] += web.write_policies(FOLDER, agent, name, label)
            act = by_policy(agent.without_partners(), own, objectives)
            drives[label] = web.drive(config, seeds, act, gamma)
            continue
        facts["policies"] += web.write_policies(FOLDER, agent, name, OFFERED["preference"])
        for weights in preferences(len(own)):
            policy = agent.policies(np.tile(weights, (1, agent.env.vehicles, 1)))
            asked.append(web.drive(config, seeds, by_policy(policy, own, objectives), gamma))
        facts["questions"] = questions(asked, seeds[0], np.array([each["scale"] for each in facts["objectives"]]))
    if "planned" in world:
        plans = [planned_actions(world["planned"], k)[0] for k in range(len(seeds))]
        facts["ghost"] = [encode(plan) for plan in plans]
        drives["the best known drive"] = web.drive(config, seeds, web.replayed([[plan] for plan in plans]))
    facts["drivers"] = [
        {"label": label, "returns": rounded(each.returns[:, 0]), "ends": [ENDS[end] for end in each.ends[:, 0]]}
        for label, each in drives.items()
    ]
    names = [*(f"preference {k + 1} of {OFFERED['preference']}" for k in range(len(asked))), *drives]
    means = np.array([each.returns[:, 0].mean(axis=0) for each in (*asked, *drives.values())])
    kept = np.flatnonzero(moocore.is_nondominated(means, maximise=True))
    facts["front"] = [{"name": names[k], "returns": rounded(means[k])} for k in kept]
    weights = make_utility(world["utility"], objectives).weights
    facts["utilities"] = [{"label": world["utility"].replace("_", " "), "weights": weights}]
    return facts


def questions(driven: list[web.Drives], seed: int, scales: np.ndarray) -> dict[str, Any]:
    """The drives of the first seed that differ, and a tree of questions about them."""
    kept = {each.returns[0, 0].tobytes(): k for k, each in reversed([*enumerate(driven)])}
    numbers = sorted(kept.values())
    returns = np.array([driven[k].returns[0, 0] for k in numbers])
    actions = [driven[k].texts(0) for k in numbers]
    return {
        **question_tree(returns / scales),
        "drives": [
            {"label": f"preference {k + 1}", "seed": seed, "actions": texts, "returns": row}
            for k, texts, row in zip(numbers, actions, rounded(returns, 9), strict=True)
        ],
    }


def main() -> None:
    """Write the files."""
    keep, rows = sys.argv[1:] == ["--keep-modules"], []
    for name, world in OFFERED["worlds"].items():
        config = web.configuration(name, world["id"], world.get("arguments", {}))
        module = (FOLDER / f"{name}.wasm").read_bytes() if keep else compile_module(config)
        rows.append(web.write_world(FOLDER, name, facts_of(world, config), module))
        print(f"{name}: {rows[-1]['bytes'] / 1000:.0f} kB", flush=True)
    web.write_page_list(FOLDER, rows)
    write_fronts(FOLDER / "explorer.json", [explorable_best_known(name) for name in OFFERED["explored"]])


if __name__ == "__main__":
    main()
