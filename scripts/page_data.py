"""Build what the page ships with: worlds as WebAssembly, policies of the zoo, and what others have earned there.

    python scripts/page_data.py                  # everything; needs wasm-ld
    python scripts/page_data.py --keep-modules   # all but the compiled worlds

Run it when the simulator, a scenario or an offered policy changes; tests say when. ``page_worlds.yaml`` says what
the page offers, and ``docs/page_files.md`` describes the files.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

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
from mo_deepdrive.evaluation import evaluate
from mo_deepdrive.evaluation.elicitation import question_tree
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.suite.plans import planned, planned_actions
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.world.action_sequences import encode

FOLDER, OFFERED = Path(str(WORLDS)), yaml.safe_load(Path(__file__).with_name("page_worlds.yaml").read_text())
PREFERENCES = 12  # under which a conditioned policy drives for comparison


def by_rule(rule: float | str) -> Any:
    """A scripted driver as a policy function: of a roundabout by its name, of the left turn by its gap (s)."""
    if not isinstance(rule, str):
        return GapDriver(GapRule(gap=rule))
    driver = make_rule(f"rule:{rule}", "discrete")
    return lambda seen, *_: driver(seen)


def by_policy(policy: Any, objectives: list[str], kept: list[Any]) -> Any:
    """A policy that learnt with some of the world's objectives as a policy function, which keeps its actions (E, V)."""
    columns, vehicles = [objectives.index(name) for name in policy.env.objectives], policy.env.vehicles

    def act(seen: Any, accrued: Any, discounts: Any) -> Any:
        shape = (len(seen), vehicles)
        own = accrued.reshape(*shape, -1)[..., columns]
        past = AccruedReward(own, discounts.reshape(shape), np.zeros(shape, dtype=np.int64))
        kept.append(policy.act(seen.reshape(*shape, -1), past, None))
        return kept[-1] if vehicles > 1 else kept[-1][:, 0]

    return act


def facts_of(world: dict[str, Any]) -> dict[str, Any]:
    """NAME.json of a world, with its policies written."""
    arguments, name_of_asked = world.get("arguments", {}), OFFERED["preference"]
    facts = web.world_facts(web.configuration("id", world["id"], arguments), world["id"], arguments)
    objectives, seeds = [objective["key"] for objective in facts["objectives"]], facts["seeds"]

    def drive(function: Any, gamma: float = 0.99) -> Any:
        return evaluate(function, world["id"], seed=seeds[0], episodes=len(seeds), env_kwargs=arguments, gamma=gamma)

    drives = {label: drive(by_rule(rule)) for label, rule in world.get("rules", {}).items()}
    asked: dict[str, Any] = {}
    for name, label in world.get("policies", {}).items():
        agent = load_policy(Run.open(name))
        gamma, follows = float(agent.accrued_discount), label == "preference"
        facts["policies"] += web.write_policies(FOLDER, agent, name, name_of_asked if follows else label)
        if not follows:
            drives[label] = drive(by_policy(agent.without_partners(), objectives, []), gamma)
            continue
        texts = []
        d = len(agent.env.objectives)
        drawn = np.random.default_rng(0).dirichlet(np.ones(d), PREFERENCES)
        drawn[:d] = 0.5 / d + 0.5 * np.eye(d)[:PREFERENCES]  # that favour one objective
        for k, weights in enumerate(drawn, start=1):
            policy, actions = agent.policies(np.tile(weights, (1, agent.env.vehicles, 1))), list[Any]()
            asked[f"preference {k}"] = drive(by_policy(policy, objectives, actions), gamma)
            lengths = asked[f"preference {k}"].lengths[0]
            texts.append([encode(np.array(actions)[:end, 0, v]) for v, end in enumerate(lengths)])
        # The drives of the first scenario that differ.
        returns = np.array([each.returns[0, 0] for each in asked.values()])
        chosen = np.sort(np.unique(returns, axis=0, return_index=True)[1])
        facts["questions"] = question_tree(returns[chosen] / [each["scale"] for each in facts["objectives"]])
        facts["questions"]["drives"] = [
            {"label": [*asked][k], "seed": seeds[0], "actions": texts[k], "returns": rounded(returns[k], 9)}
            for k in chosen
        ]
    if "planned" in world:
        facts["ghost"] = [encode(planned_actions(world["planned"], k)[0]) for k in range(len(seeds))]
        drives["the best known drive"] = drive(planned(world["planned"]))
    facts["drivers"] = [
        {"label": label, "returns": rounded(each.returns[:, 0]), "ends": each.ends[:, 0].tolist()}
        for label, each in drives.items()
    ]
    compared = {**{f"{label} of {name_of_asked}": each for label, each in asked.items()}, **drives}
    means = np.array([each.returns[:, 0].mean(axis=0) for each in compared.values()])
    best = zip(compared, means, moocore.is_nondominated(means, maximise=True), strict=True)
    facts["front"] = [{"name": name, "returns": rounded(mean)} for name, mean, kept in best if kept]
    weights = make_utility(world["utility"], objectives).weights
    facts["utilities"] = [{"label": world["utility"].replace("_", " "), "weights": weights}]
    return facts


def main() -> None:
    """Write the files."""
    (FOLDER / web.PAGE).unlink(missing_ok=True)
    for name, world in reversed(OFFERED["worlds"].items()):
        config = web.configuration(name, world["id"], world.get("arguments", {}))
        keep = sys.argv[1:] == ["--keep-modules"]
        module = (FOLDER / f"{name}.wasm").read_bytes() if keep else compile_module(config)
        web.write_world(FOLDER, name, facts_of(world), module)
        print(name, flush=True)
    write_fronts(FOLDER / "explorer.json", [explorable_best_known(name) for name in OFFERED["explored"]])


if __name__ == "__main__":
    main()
