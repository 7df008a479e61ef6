"""The worlds and policies that the page ships, run by the page's own code in Node, and links."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from algorithms.runs import web
from algorithms.runs.build import load_policy
from algorithms.runs.run_directory import Run
from mo_deepdrive import __version__
from mo_deepdrive.device import wasm
from mo_deepdrive.device.pcg64 import STREAM, draw, seed_stream
from tests.helpers.page_worlds import (
    FOLDER,
    NAMES,
    PAGE,
    SEED,
    check_drive,
    configuration,
    drive_on_cpu,
    random_actions,
)
from tests.helpers.paths import REPOSITORY

POLICIES = [
    (name, policy["name"]) for name in NAMES for policy in json.loads((FOLDER / f"{name}.json").read_text())["policies"]
]
needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="needs Node")


def in_node(what: str, name: str, given: Any, folder: Path) -> Path:
    """The output of tests/helpers/page.mjs."""
    (folder / "input.json").write_text(json.dumps(given))
    script, output = REPOSITORY / "tests/helpers/page.mjs", folder / "output"
    subprocess.run(["node", script, what, FOLDER, name, folder / "input.json", output], check=True)
    return output


@needs_node
@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_world_drives_as_on_the_cpu_for_1000_decisions_with_resets(name: str, tmp_path: Path) -> None:
    actions, expected = drive_on_cpu(name)
    output = in_node("world", name, {"seed": SEED, "actions": actions.tolist()}, tmp_path)
    check_drive(name, np.fromfile(output, dtype=expected.dtype), expected)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_said_of_a_shipped_world_is_that_of_this_version(name: str) -> None:
    facts, config = configuration(name)
    assert PAGE["version"] == __version__
    present = json.loads(json.dumps(web.world_facts(config, facts["id"], facts["arguments"])))
    shown = ("policies", "drivers", "ghost", "front", "utilities", "questions")
    assert {key: facts[key] for key in present if key not in shown} == {
        key: value for key, value in present.items() if key not in shown
    }
    for kept in (facts["questions"] or {"drives": []})["drives"][:2]:
        link = web.Link(facts["id"], facts["arguments"], kept["seed"], "you", __version__, kept["actions"])
        np.testing.assert_allclose(link.replay()[0].returns[0, 0], kept["returns"], rtol=1e-6)


@needs_node
@pytest.mark.slow
@pytest.mark.parametrize(("world", "name"), POLICIES)
def test_a_network_answers_on_the_page_as_in_torch(world: str, name: str, tmp_path: Path) -> None:
    facts, rng = json.loads((FOLDER / f"{name}.json").read_text()), np.random.default_rng(0)
    zoo_name, _, number = name.rpartition("-") if re.search(r"-\d$", name) else (name, "", 0)
    agent = load_policy(Run.open(zoo_name))
    o, d, count = agent.env.observation_size, len(facts["objectives"]), 1000
    scales = np.asarray(agent.observation_scales).reshape(-1)
    seen = (scales * rng.normal(size=(count, o))).astype(np.float32)
    accrued, discounts = rng.normal(size=(count, d)).astype(np.float32) * 10, rng.random(count, dtype=np.float32)
    weights = rng.dirichlet(np.ones(d), count).astype(np.float32)
    given = [seen, accrued, discounts, weights]
    preference = (torch.from_numpy(weights), agent.ideal[0]) if facts["preference"] else None
    with torch.no_grad():
        inputs = agent.inputs(*(torch.from_numpy(each).double() for each in given[:3]), preference)
        expected = agent.learners[int(number)].actor.body.double()(inputs.double()).numpy()
    rows = [list(row) for row in zip(*(each.tolist() for each in given), strict=True)]
    outputs = np.array(json.loads(in_node("actor", name, rows, tmp_path).read_text()))
    np.testing.assert_allclose(outputs, expected, rtol=1e-5, atol=1e-5)
    best = np.sort(expected, axis=1)
    clear = best[:, -1] - best[:, -2] > 1e-4
    assert (outputs.argmax(axis=1) == expected.argmax(axis=1))[clear].all()


@needs_node
def test_a_link_of_the_page_replays_to_the_same_returns(tmp_path: Path) -> None:
    _, config = configuration("roundabout")
    actions = random_actions(config, config.max_decisions)[:, 0]
    kept = json.loads(in_node("link", "roundabout", {"seed": SEED, "actions": actions.tolist()}, tmp_path).read_text())
    link = web.Link.read(f"https://a.page/{kept['link']}")
    assert (link.driver, link.seed, link.arguments) == ("you", SEED, {"vehicles": 8})
    driven, _ = link.replay()
    np.testing.assert_array_equal(driven.returns[0], kept["returns"])
    assert driven.ends[0].tolist() == kept["ends"]
    for cut in (kept["link"][:-9], kept["link"][:-1], kept["link"].replace("e", "f", 3), "", "#drive=."):
        with pytest.raises(ValueError, match=r"cut or edited|no drive"):
            web.Link.read(cut)


def test_the_random_numbers_are_those_of_numpy() -> None:
    stream, drawn = np.zeros(STREAM, np.uint64), np.zeros((1, 20))
    for seed in (0, 7, SEED, 2**32 + 5, 2**63 + 11):
        seed_stream(np.uint64(seed), stream)
        draw(stream, np.zeros(1, np.int64), 0, drawn)
        assert drawn[0].tolist() == np.random.default_rng(seed).random(20).tolist()


def test_without_a_linker_one_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    monkeypatch.setattr(wasm, "find_spec", lambda _name: None)
    with pytest.raises(OSError, match=r"lld, or pip install --editable '\.\[web\]'"):
        wasm.find_linker()
