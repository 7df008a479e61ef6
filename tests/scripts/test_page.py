"""The commands of the page: a page of one's own worlds, the page that is shipped, and links that are driven again."""

from __future__ import annotations

import base64
import http.client
import json
import os
import signal
import subprocess
import sys
import textwrap
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from algorithms.commands.choose import ask
from mo_deepdrive import __version__
from mo_deepdrive.device.wasm import find_linker
from mo_deepdrive.evaluation.elicitation import QUESTIONS, question_tree
from tests.helpers.paths import REPOSITORY
from tests.helpers.script_runs import Call, refused

LEFT_TURN = "mo-deepdrive-left-turn-v1"


def link_of(**changes: Any) -> str:
    kept = {
        **{"format": 1, "version": __version__, "id": LEFT_TURN, "arguments": {}, "seed": 3_000_000, "driver": "you"},
        "actions": ["d50a2"],
        **changes,
    }
    payload = base64.urlsafe_b64encode(json.dumps(kept).encode()).decode().rstrip("=")
    return f"https://a.page/#drive={payload}.{zlib.crc32(payload.encode()):08x}"


def test_a_link_is_driven_again_and_shows_its_returns_with_units(call: Call) -> None:
    code, out, error = call("replay", link_of())
    assert code == 0, error
    assert "seed 3000000, driven by you" in out
    _, _, header, units, *_ = out.splitlines()
    assert "distance" in header
    assert " m " in units
    assert "returns may differ" in call("replay", link_of(version="0.0"))[2]


@pytest.mark.parametrize(
    ("link", "message"),
    [
        (link_of()[:-1], "LINK was cut or edited"),
        (link_of(format=2), "LINK holds no drive of this version"),
        (link_of(id="CartPole-v1"), "only this package's environments"),
        (link_of(actions=["a", "b"]), "actions of 2 vehicles; mo-deepdrive-left-turn-v1 has 1"),
        (link_of(actions=["z"]), "'z' is not a sequence of discrete actions"),
        (link_of(arguments={"wheels": 3}), "wheels"),
    ],
)
def test_a_link_that_holds_no_drive_is_refused(call: Call, link: str, message: str) -> None:
    refused(call("replay", link), message)


def test_a_page_of_ones_own_takes_what_keys_can_drive(call: Call) -> None:
    build = ("web", "build", "--output", "page", "--env")
    refused(call(*build, "CartPole-v1"), "only this package's environments")
    refused(call(*build, LEFT_TURN, "--arguments", "{action_type: continuous}"), "cannot be driven with keys")
    refused(call(*build, LEFT_TURN, "--arguments", "3"), "--arguments '3' must be a mapping")
    refused(call("play"), "--env ID or --web is required")
    refused(call("play", "--web", "--env", LEFT_TURN), "omit --env and --against")


@pytest.mark.slow
def test_a_scenario_and_objective_of_ones_own_become_a_page(call: Call, registries: None, tmp_path: Path) -> None:
    try:
        find_linker()
    except OSError as error:
        pytest.skip(str(error))
    code = """
        import numpy as np
        from mo_deepdrive import Objective, Route, Scenario, register_objective, register_scenario

        def steering(vehicles, v, params):
            return abs(vehicles[v].steer)

        def listing(vehicles, v, params):
            return np.zeros(int(vehicles[v].decisions) + 1).sum()

        for measure in (steering, listing):
            register_objective(Objective(measure.__name__, "rad", -1, 1.0, "of a test", bound=1.0, measure=measure))
        route = Route(start=(7.0, 25.0, -1.5), waypoints=((20.0, 5.0),))
        register_scenario(Scenario(name="bend", title="Bend", routes=(route,), objectives=("distance",)))
    """
    (tmp_path / "bends.py").write_text(textwrap.dedent(code))
    build = ("web", "build", "--env", "bends:mo-deepdrive-bend-v0", "--output", "page", "--arguments")
    code, out, error = call(*build, "{objectives: [distance, steering]}")
    assert code == 0, error
    assert "http.server" in out
    worlds = json.loads((tmp_path / "page/page.json").read_text())["worlds"]
    assert [world["title"] for world in worlds[:2]] == ["Bend", "LeftTurn"]
    assert (tmp_path / "page/own.wasm").read_bytes()[:4] == b"\0asm"
    facts = json.loads((tmp_path / "page/own.json").read_text())
    assert [objective["key"] for objective in facts["objectives"]] == ["distance", "steering"]
    refused(call(*build, "{objectives: [distance, listing]}"), "cannot be compiled for a browser")


@pytest.mark.processes
def test_the_page_is_served_from_an_installed_package() -> None:
    command = [sys.executable, "-m", "mo_deepdrive", "play", "--web"]
    environment = {**os.environ, "BROWSER": "true", "PYTHONPATH": str(REPOSITORY)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().split()[0]
            for name, kind in (
                ("", "text/html"),
                ("page.json", "application/json"),
                ("left_turn.wasm", "application/wasm"),
            ):
                connection = http.client.HTTPConnection(address.split("/")[2], timeout=30)
                connection.request("GET", f"/{name}")
                answer = connection.getresponse()
                assert (answer.status, answer.headers["Content-Type"]) == (200, kind)
                connection.close()
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0


def test_answers_to_questions_find_the_weights_behind_them(monkeypatch: pytest.MonkeyPatch) -> None:
    scales, wanted = np.array([10.0, 5.0, 1.0]), np.array([0.1, 0.8, 0.1])
    means = np.random.default_rng(4).normal(size=(12, 3)) * scales
    worth, printed = (means / scales) @ wanted, list[str]()
    monkeypatch.setattr("builtins.print", lambda text, **_: printed.extend(text.split("\n")))

    def answer(_prompt: str) -> str:
        rows = [[float(word) for word in line.split()[1:]] for line in printed[-3:]]
        first, second = (np.array(column) / scales @ wanted for column in zip(*rows, strict=True))
        return "1" if first > second else "2"

    monkeypatch.setattr("builtins.input", answer)
    criterion = ask(means, ("a", "b", "c"), scales)
    assert sum(line.startswith("question") for line in printed) == QUESTIONS
    chosen = criterion.values(means[:, None]).argmax()
    assert worth[chosen] > worth.max() - 0.1
    # The page goes down a tree of the same questions.
    tree, node = question_tree(means / scales), 1
    while node < 2**QUESTIONS:
        first, second = tree["ask"][node - 1]
        node = 2 * node + (worth[first] < worth[second])
    found = tree["found"][node - 2**QUESTIONS]
    assert found["best"] == chosen
    assert np.argmax(found["weights"]) == 1
    assert (np.array(found["low"]) <= found["weights"]).all()
