"""The worlds that the page ships, in a browser."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import pytest

from tests.helpers.page_worlds import FOLDER, NAMES, SEED, check_drive, drive_on_cpu

pytestmark = [pytest.mark.slow, pytest.mark.browser]

DRIVE = """
const [text, facts, seed, actions, done] = arguments;
const code = await WebAssembly.compile(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)));
const maths = WebAssembly.Module.imports(code).map(({ name }) => [name, Math[name]]);
const world = (await WebAssembly.instantiate(code, { env: Object.fromEntries(maths) })).exports;
const V = facts.vehicles;
const view = (Kind, name, length) => new Kind(world.memory.buffer, world[name].value, length);
const sizes = { observations: 4 * V * facts.observations.length, rewards: 4 * V * facts.objectives.length,
  worlds: V * facts.state.size };
const ended = view(Uint8Array, "ended", V), late = view(Uint8Array, "timed_out", V);
const parts = [];
world.seed(BigInt(seed));
world.restart();
for (const chosen of actions) {
  view(Int32Array, "actions", V).set(chosen);
  world.step();
  for (const [name, size] of Object.entries(sizes)) parts.push(view(Uint8Array, name, size).slice());
  if (ended.every((one, v) => one || late[v])) world.restart();
}
const reader = new FileReader();
reader.onload = () => done(reader.result.split(",")[1]);
reader.readAsDataURL(new Blob(parts));
"""


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_world_drives_as_on_the_cpu_for_1000_decisions_with_resets(browser: Any, name: str) -> None:
    actions, expected = drive_on_cpu(name)
    facts = json.loads((FOLDER / f"{name}.json").read_text())
    module = base64.b64encode((FOLDER / f"{name}.wasm").read_bytes()).decode()
    browser.get("about:blank")
    kept = browser.execute_async_script(
        f"(async function () {{{DRIVE}}}).apply(null, arguments)", module, facts, SEED, actions.tolist()
    )
    check_drive(name, np.frombuffer(base64.b64decode(kept), dtype=expected.dtype), expected)
