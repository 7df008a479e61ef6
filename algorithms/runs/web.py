"""The files from which the page drives: worlds, policies, and what other drivers have earned, in one directory.

``page.json`` is read first; names of files are relative to it. All texts are UTF-8, all numbers finite.

    page.json     {format: 1, version, worlds: [{name, title, id, vehicles, json, wasm, bytes, conditioned, rivals,
                  questions}], in the order of the menu: with discrete actions only; the last three say whether there
                  are conditioned policies, policies or a ghost, and questions
    NAME.json     what :mod:`mo_deepdrive.device.wasm` says of a world, ``version`` of the package, and
        scene         what is drawn in all its episodes, as of :func:`algorithms.reporting.page.data.scene_to_json`
        seeds         the seeds that the page offers, of the test split, in order
        policies      [{name, label, file, bytes, conditioned, vehicles}], learners whose networks the page runs, and
                      the vehicles that each can drive
        drivers       [{label, returns: [[d] by seed], ends: [by seed]}]: rules, learners and planned drives on these
                      seeds; of several vehicles, those of vehicle 0 where all drive so
        ghost         null, or [actions by seed]: the best known drive of every seed, as texts, see below
        front         [{name, returns: [d]}]: mean returns over the seeds of drives that nothing dominates
        utilities     [{label, weights: [d]}], linear ones that are named; u = sum_i weights_i returns_i
        questions     null, or {drives: [{label, seed, actions: [a text per vehicle], returns: [d]}], ask, found}:
                      :func:`mo_deepdrive.evaluation.elicitation.question_tree`, a tree of all answers
    POLICY.json   {format, name, label, objectives: [names, of its own d], inputs, scales, activation, layers: [[out,
                  in]], weights, gamma, preference}
        inputs        which parts the network sees, in this order, joined: "observation" (o), "accrued" (d, the sum of
                      gamma^i r_i so far), "discount" (1, gamma^t), "preference" (d, weights that add up to 1)
        scales        one number for every entry of the input, by which it is divided
        activation    of all but the last layer: "relu" or "tanh"
        weights       base64 of float32, little-endian: of every layer the matrix by rows [out][in], then the biases
        preference    null, or [weights]: of a conditioned policy, where it starts

The outputs of a network are logits; the greedy action is the first greatest one.

Actions as texts are runs of equal ones, :func:`mo_deepdrive.world.action_sequences.encode`: "d12a" is 12 times action 3
and once action 0; continuous ones are "steer,acceleration[,brake][*times]", separated by spaces, in 1/1024, without the
brake where it is -1024.

A link ends in ``#drive=PAYLOAD.CHECK``: PAYLOAD is base64url without padding of the JSON {format: 1, version, id,
arguments, seed, driver, actions: [a text for each of the V vehicles]}, CHECK eight hexadecimal digits of the CRC-32 of
PAYLOAD (its ASCII characters). Vehicles that have ended need no further actions. ``mo-deepdrive replay LINK`` reads it.
"""

from __future__ import annotations

import base64
import json
import zlib
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from torch import nn

import mo_deepdrive
from algorithms.conditioned_mo_ppo import ConditionedMOPPO
from algorithms.learning.actors import CategoricalActor
from algorithms.reporting.page.data import MARGIN, scene_to_json
from algorithms.runs.config import find_environment
from mo_deepdrive.device.wasm import describe
from mo_deepdrive.evaluation.drives import Scene, road
from mo_deepdrive.evaluation.metrics import name_and_unit
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.simulation.state import MAP_SIZE
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.world.action_sequences import decode, encode
from mo_deepdrive.world.batch import Draws, WorldBatch
from mo_deepdrive.world.config import is_ours, parse_arguments

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from mo_deepdrive.world.config import EnvConfig

FORMAT = 1
PAGE, MARK = "page.json", "#drive="
SEEDS = 20  # that the page offers
ACTIVATIONS = {nn.ReLU: "relu", nn.Tanh: "tanh"}


def configuration(option: str, env_id: str, arguments: Mapping[str, Any]) -> EnvConfig:
    """The configuration of one of this package's environments, by its id, or ``module:ID``, and arguments.

    A ValueError, with the name of the ``option``, for another environment or an argument that is not valid.
    """
    spec = find_environment(env_id, option)
    if not is_ours(spec):
        raise ValueError(f"{option} {env_id!r}: only this package's environments can be driven")
    own = {**spec.kwargs, **arguments}
    try:
        return parse_arguments(own.pop("scenario"), own)
    except TypeError as error:
        raise ValueError(f"{option} {env_id}: {error}") from None


def world_facts(config: EnvConfig, env_id: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """NAME.json of a world that nobody has driven in."""
    scenario, facts = config.scenario_data, describe(config, env_id, arguments)
    for objective in facts["objectives"]:
        objective["name"], objective["unit"] = name_and_unit(objective["key"])
    roads = tuple(map(road, scenario.routes)) if scenario.roads else ()
    seen = () if roads else (np.array([[MARGIN] * 2, [MAP_SIZE - MARGIN] * 2]),)
    scene = Scene(0, seen, np.zeros((0, 2, 2)), scenario.lanes, roads, config.decision_frequency, ())
    nothing: dict[str, Any] = {name: [] for name in ("policies", "drivers", "front", "utilities")}
    return {
        **{**facts, "version": mo_deepdrive.__version__, "scene": scene_to_json(scene)},
        **{"seeds": list(SPLITS["test"][:SEEDS]), "ghost": None, "questions": None, **nothing},
    }


def write_json(file: Path, contents: Mapping[str, Any]) -> int:
    """Write a file without spaces; returns its size in bytes."""
    text = json.dumps(contents, allow_nan=False, separators=(",", ":")).encode()
    atomic_write(file, text)
    return len(text)


def write_world(folder: Path, name: str, facts: Mapping[str, Any], module: bytes) -> dict[str, Any]:
    """Write NAME.json and NAME.wasm; returns the row of page.json."""
    atomic_write(folder / f"{name}.wasm", module)
    size = write_json(folder / f"{name}.json", facts) + len(module)
    return {
        **{"name": name, "title": facts["title"], "id": facts["id"], "vehicles": facts["vehicles"]},
        **{"json": f"{name}.json", "wasm": f"{name}.wasm", "bytes": size},
        "conditioned": any(policy["conditioned"] for policy in facts["policies"]),
        "rivals": bool(facts["policies"] or facts["ghost"]),
        "questions": facts["questions"] is not None,
    }


def write_page_list(folder: Path, worlds: Sequence[Mapping[str, Any]]) -> None:
    """Write page.json."""
    write_json(folder / PAGE, {"format": FORMAT, "version": mo_deepdrive.__version__, "worlds": list(worlds)})


def write_policies(folder: Path, agent: Any, name: str, label: str) -> list[dict[str, Any]]:
    """Write the networks of an agent; returns their rows in NAME.json.

    A ValueError for an agent whose actions are not discrete, or whose network is not a multilayer perceptron.
    """
    rows = []
    for number, learner in enumerate(agent.learners):
        own = name if len(agent.learners) == 1 else f"{name}-{number}"
        size = write_json(folder / f"{own}.json", _policy(agent, learner.actor, own, label))
        row = {"name": own, "label": label, "file": f"{own}.json", "bytes": size, "vehicles": list(learner.vehicles)}
        rows.append({**row, "conditioned": isinstance(agent, ConditionedMOPPO)})
    return rows


def _policy(agent: Any, actor: Any, name: str, label: str) -> dict[str, Any]:
    layers: list[Any] = list(actor.body) if isinstance(actor.body, nn.Sequential) else []
    bends = {ACTIVATIONS.get(type(layer)) for layer in layers[1::2]}
    if not isinstance(actor, CategoricalActor) or len(bends) != 1 or None in bends:
        raise ValueError(f"{name}: the page runs perceptrons with relu or tanh that choose one of several actions")
    d, conditioned = len(agent.env.objectives), isinstance(agent, ConditionedMOPPO)
    scales = {"observation": np.asarray(agent.observation_scales).reshape(-1)}
    if conditioned:
        if agent.preferences.width != d:
            raise ValueError(f"{name}: the page gives weights, and this policy follows other preferences, too")
        scales["preference"] = np.asarray(agent.preferences.divisors / agent.preferences.factors)
    else:
        scales |= {"accrued": np.asarray(agent.objective_scales).reshape(-1)} if agent.observes_accrued else {}
        scales |= {"discount": np.ones(1)} if agent.observes_discount else {}
    parameters = [part.detach().numpy().ravel() for layer in layers[::2] for part in (layer.weight, layer.bias)]
    return {
        **{"format": FORMAT, "name": name, "label": label, "objectives": list(agent.env.objectives)},
        **{"inputs": list(scales), "scales": np.concatenate([*scales.values()]).astype(float).tolist()},
        **{"activation": bends.pop(), "layers": [list(layer.weight.shape) for layer in layers[::2]]},
        "weights": base64.b64encode(np.concatenate(parameters).astype("<f4").tobytes()).decode(),
        **{"gamma": float(agent.accrued_discount), "preference": [1.0 / d] * d if conditioned else None},
    }


class Drives(NamedTuple):
    """E episodes, one per seed, of V vehicles."""

    returns: NDArray[np.float64]  #: (E, V, d), in double precision
    ends: NDArray[np.int64]  #: (E, V), positions in ENDS
    actions: NDArray[Any]  #: (T, E, V) or (T, E, V, 3), those of ended vehicles, too
    lengths: NDArray[np.int64]  #: (E, V) decisions

    def texts(self, episode: int) -> list[str]:
        """The actions of every vehicle up to its end, as texts."""
        return [encode(self.actions[:end, episode, v]) for v, end in enumerate(self.lengths[episode])]


def drive(
    config: EnvConfig, seeds: Sequence[int], act: Callable[..., Any], gamma: float = 1.0, most: float = np.inf
) -> Drives:
    """Drive the scenarios of some seeds as the page does, to the end or for at most so many decisions.

    ``act(observations (E, V, o), past)`` gives the actions, ``past`` an AccruedReward with the discount ``gamma``.
    """
    batch = WorldBatch(config, len(seeds))
    batch.place(Draws(len(seeds), batch.scenario.draws, [np.random.default_rng(seed) for seed in seeds]))
    past, returns = AccruedReward.begin(*batch.rewards.shape), np.zeros(batch.rewards.shape)
    actions, acted = [], [np.zeros(batch.acted.shape, dtype=np.int64)]
    while not batch.over().all() and len(actions) < most:
        actions.append(np.array(act(batch.observations, past)))
        batch.step(actions[-1])
        past.add(batch.rewards, gamma)
        returns += batch.rewards
        acted.append(batch.acted.copy())
    return Drives(returns, batch.state["end"].copy(), np.array(actions), np.sum(acted, axis=0))


def replayed(sequences: Sequence[Sequence[NDArray[Any]]]) -> Callable[..., NDArray[Any]]:
    """What drives every vehicle of every episode by its own actions (n,) or (n, 3), and by zeros after them."""
    longest = max(len(actions) for episode in sequences for actions in episode)
    whole = np.zeros(
        (longest + 1, len(sequences), len(sequences[0]), *sequences[0][0].shape[1:]), sequences[0][0].dtype
    )
    for row, episode in enumerate(sequences):
        for v, actions in enumerate(episode):
            whole[: len(actions), row, v] = actions
    return lambda _seen, past: whole[min(int(past.decisions[0, 0]), longest)]


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

    def replay(self) -> tuple[EnvConfig, Drives]:
        """Drive it again, as far as its actions go. A ValueError if it fits no environment of this version."""
        config = configuration("LINK: environment", self.id, self.arguments)
        sequences, vehicles = [decode(text, config.action_type) for text in self.actions], config.scenario_data.vehicles
        if len(sequences) != vehicles:
            raise ValueError(f"LINK has actions of {len(sequences)} vehicles; {self.id} has {vehicles}")
        return config, drive(config, [self.seed], replayed([sequences]), most=max(map(len, sequences)))
