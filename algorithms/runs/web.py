"""The files from which the page drives: worlds, policies, and what other drivers have earned, in one directory.

``page.json`` has the menu, NAME.json and NAME.wasm are a world, POLICY.json a network; ``docs/page_files.md`` describes
them, and the links that keep a drive.
"""

from __future__ import annotations

import base64
import json
import zlib
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import mo_deepdrive
from algorithms.reporting.page.data import MARGIN, scene_to_json
from algorithms.reporting.page.page import as_json
from algorithms.runs.config import find_environment, with_every_argument
from mo_deepdrive.evaluation.drives import Playback, Scene, road
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.metrics import name_and_unit
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.simulation.state import ENDS, MAP_SIZE
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.world.action_sequences import decode, idle
from mo_deepdrive.world.actions import action_names
from mo_deepdrive.world.batch import WorldBatch
from mo_deepdrive.world.config import EnvironmentSettings
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES
from mo_deepdrive.world.observation import layout

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.world.config import EnvConfig

FORMAT = 1
PAGE, MARK = "page.json", "#drive="
SEEDS = 20  # that the page offers
ACTIVATIONS = {"ReLU": "relu", "Tanh": "tanh"}  # by their names in PyTorch
CONDITIONED = "conditioned_mo_ppo"


def configuration(option: str, env_id: str, arguments: Mapping[str, Any]) -> EnvConfig:
    """The configuration of one of this package's environments, by its id, or ``module:ID``, and arguments.

    A ValueError, with the name of the ``option``, for another environment or an argument that is not valid.
    """
    find_environment(env_id, option)
    _, config = with_every_argument(EnvironmentSettings(id=env_id, arguments=dict(arguments)))
    if config is None:
        raise ValueError(f"{option} {env_id!r}: only this package's environments can be driven")
    return config


def world_facts(config: EnvConfig, env_id: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """NAME.json of a world that nobody has driven in."""
    world = WorldBatch(config, 1)
    scenario, record = world.scenario, world.state.dtype
    cars, roads = record["cars"].base, tuple(map(road, scenario.routes)) if scenario.roads else ()
    seen = () if roads else (np.array([[MARGIN] * 2, [MAP_SIZE - MARGIN] * 2]),)
    scene = Scene(0, seen, np.zeros((0, 2, 2)), scenario.lanes, roads, config.decision_frequency, ())
    objectives = [
        {"key": each.name, "name": name, "unit": unit, "sign": each.sign, "scale": each.scale}
        for each in (OBJECTIVES[INDEX[key]] for key in world.objectives)
        for name, unit in [name_and_unit(each.name)]
    ]
    nothing: dict[str, Any] = {name: [] for name in ("policies", "drivers", "front", "utilities")}
    return {
        **{"format": FORMAT, "id": env_id, "arguments": dict(arguments), "title": scenario.title},
        **{"scenario": scenario.name, "vehicles": scenario.vehicles, "frequency": config.decision_frequency},
        **{"continuous": world.continuous, "actionNames": list(action_names(config.action_type))},
        **{"maxDecisions": config.max_decisions, "ends": list(ENDS), "objectives": objectives},
        "observations": [{"name": each.name, "unit": each.unit, "scale": each.scale} for each in layout(scenario)],
        "state": {"size": record.itemsize, "fields": _fields(record)},
        "cars": {
            **{"offset": record.fields["cars"][1], "size": cars.itemsize, "count": scenario.cars},
            "fields": _fields(cars),
        },
        "obstacles": {"offset": record.fields["obstacle"][1], "count": scenario.obstacles},
        **{"version": mo_deepdrive.__version__, "scene": scene_to_json(scene)},
        **{"seeds": list(SPLITS["test"][:SEEDS]), "ghost": None, "questions": None, **nothing},
    }


def _fields(record: Any) -> dict[str, list[Any]]:
    """[offset, type, count] of the numbers in a record."""
    return {
        name: [offset, kind.base.str[1:], int(np.prod(kind.shape, dtype=int))]
        for name, (kind, offset, *_) in record.fields.items()
        if kind.base.names is None and not name.startswith("gap_")
    }


def write_world(folder: Path, name: str, facts: Mapping[str, Any], module: bytes) -> None:
    """Write NAME.json and NAME.wasm, and page.json with this world before those that are in it."""
    atomic_write(folder / f"{name}.wasm", module)
    atomic_write(folder / f"{name}.json", as_json(facts).encode())
    row = {
        **{"name": name, "title": facts["title"], "id": facts["id"], "vehicles": facts["vehicles"]},
        **{"json": f"{name}.json", "wasm": f"{name}.wasm"},
        "conditioned": any(policy["conditioned"] for policy in facts["policies"]),
        "rivals": bool(facts["policies"] or facts["ghost"]),
        "questions": facts["questions"] is not None,
    }
    page = folder / PAGE
    others = json.loads(page.read_text(encoding="utf-8"))["worlds"] if page.exists() else []
    rows = [row, *(other for other in others if other["name"] != name)]
    atomic_write(page, as_json({"format": FORMAT, "version": mo_deepdrive.__version__, "worlds": rows}).encode())


def write_policies(folder: Path, agent: Any, name: str, label: str) -> list[dict[str, Any]]:
    """Write the networks of an agent; returns their rows in NAME.json.

    A ValueError for an agent whose actions are not discrete, whose network is not a multilayer perceptron, or whose
    preferences are not weights.
    """
    rows, d, conditioned = [], len(agent.env.objectives), agent.name == CONDITIONED
    scales = {"observation": np.asarray(agent.observation_scales).reshape(-1)}
    if conditioned:
        if agent.preferences.width != d:
            raise ValueError(f"{name}: the page gives weights, and this policy follows other preferences, too")
        scales["preference"] = np.asarray(agent.preferences.divisors / agent.preferences.factors)
    else:
        scales |= {"accrued": np.asarray(agent.objective_scales).reshape(-1)} if agent.observes_accrued else {}
        scales |= {"discount": np.ones(1)} if agent.observes_discount else {}
    for number, learner in enumerate(agent.learners):
        own = name if len(agent.learners) == 1 else f"{name}-{number}"
        body = learner.actor.body
        layers = [*body.children()]
        bends = {ACTIVATIONS.get(type(layer).__name__) for layer in layers[1::2]}
        if agent.env.continuous or type(body).__name__ != "Sequential" or len(bends) != 1 or None in bends:
            raise ValueError(f"{name}: the page runs perceptrons with relu or tanh that choose one of several actions")
        numbers = [part.detach().numpy().ravel() for layer in layers[::2] for part in (layer.weight, layer.bias)]
        facts = {
            **{"format": FORMAT, "name": own, "label": label, "objectives": list(agent.env.objectives)},
            **{"inputs": list(scales), "scales": np.concatenate([*scales.values()]).astype(float).tolist()},
            **{"activation": bends.pop(), "layers": [list(layer.weight.shape) for layer in layers[::2]]},
            "weights": base64.b64encode(np.concatenate(numbers).astype("<f4").tobytes()).decode(),
            **{"gamma": float(agent.accrued_discount), "preference": [1.0 / d] * d if conditioned else None},
        }
        atomic_write(folder / f"{own}.json", as_json(facts).encode())
        row = {"name": own, "label": label, "file": f"{own}.json", "vehicles": list(learner.vehicles)}
        rows.append({**row, "conditioned": conditioned})
    return rows


class Link(NamedTuple):
    """A drive that a link holds."""

    id: str
    arguments: dict[str, Any]
    seed: int
    driver: str
    version: str
    actions: list[str]

    @classmethod
    def read(cls, text: str) -> Link:
        """The drive of a link, or of what follows ``#drive=`` in it; a ValueError if it was cut or edited."""
        payload, _, check = text.rpartition(MARK)[2].strip().partition(".")
        if f"{zlib.crc32(payload.encode()):08x}" != check:
            raise ValueError("LINK was cut or edited: its end does not fit its beginning. Copy the whole link again")
        try:
            kept = json.loads(base64.urlsafe_b64decode(payload + "=" * (-len(payload) % 4)))
            if kept.pop("format") == FORMAT:
                return cls(**kept)
        except (ValueError, TypeError, KeyError, AttributeError):
            pass
        raise ValueError("LINK holds no drive of this version: open it with the page of its version")

    def replay(self) -> tuple[Evaluation, int]:
        """Drive it again, with decisions per second; after its actions a vehicle idles.

        A ValueError if it fits no environment of this version.
        """
        config = configuration("LINK: environment", self.id, self.arguments)
        vehicles, nothing = config.scenario_data.vehicles, idle(config.action_type)
        sequences = [decode(text, config.action_type) for text in self.actions]
        if len(sequences) != vehicles:
            raise ValueError(f"LINK has actions of {len(sequences)} vehicles; {self.id} has {vehicles}")
        joint = np.array([*zip_longest(*sequences, fillvalue=nothing)]).reshape(-1, vehicles, *nothing.shape)
        playback = Playback([joint if vehicles > 1 else joint[:, 0]], config.action_type)
        arguments = {**self.arguments, "cost_sign": "maximise"}
        driven = evaluate(playback, self.id, seed=self.seed, episodes=1, env_kwargs=arguments)
        return driven, config.decision_frequency
