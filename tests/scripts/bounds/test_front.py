"""scripts/bounds/front.py: what it writes is reproducible, evaluated in the simulation, and never a smaller front."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from algorithms.runs.build import build
from algorithms.runs.config import load_experiment
from mo_deepdrive.fronts.reference_fronts import GAMMA, front_config
from mo_deepdrive.fronts.reference_fronts import read as read_front
from mo_deepdrive.fronts.reference_fronts import write as format_front
from mo_deepdrive.world.action_sequences import decode as decode_actions
from mo_deepdrive.world.action_sequences import discounted_sum
from mo_deepdrive.world.action_sequences import replay as replay_sequences
from scripts.bounds import front
from scripts.bounds.front import FrontSearchSettings, improve_front, record_run
from tests.helpers.script_runs import exit_code

pytestmark = pytest.mark.slow

OPEN = ("one_waypoint", "static_obstacle")
SMALL = ["--decisions", "300000", "--anew"]
RUN = "one_waypoint_linear-a2c-printed"  # in the zoo


@pytest.fixture
def shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the script reads and writes the shipped front in a test; there is none yet."""
    file = tmp_path / "shipped.json"
    monkeypatch.setattr(front, "shipped_front_file", lambda scenario, action_type: file)
    return file


@pytest.mark.parametrize("scenario", OPEN)
@pytest.mark.parametrize("action_type", ["discrete", "discrete-16", "continuous"])
def test_a_search_writes_policies_with_the_returns_of_their_replay(
    tmp_path: Path, scenario: str, action_type: str
) -> None:
    file = tmp_path / "front.json"
    arguments = ["--scenario", scenario, "--action-type", action_type, *SMALL, "--output", str(file)]
    assert front.main(arguments) == 0
    text = file.read_text(encoding="utf-8")
    policies = read_front(text)
    assert format_front(scenario, action_type, policies) == text
    sequences = [decode_actions(policy.actions, action_type) for policy in policies]
    replayed = discounted_sum(replay_sequences(front_config(scenario, action_type), sequences), GAMMA)
    np.testing.assert_allclose(replayed, [policy.discounted for policy in policies], rtol=1e-5, atol=2e-5)
    assert (np.diff(replayed[:, 0]) <= 1e-5).all()
    assert {policy.source for policy in policies} == {
        f"python scripts/bounds/front.py --scenario {scenario} --action-type {action_type} "
        "--decisions 300000 --seed 0 --anew"
    }


def test_the_same_seed_writes_the_same_file_and_another_seed_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(front, "POPULATION", 256)
    files = [tmp_path / f"{name}.json" for name in "abc"]
    for file, seed in zip(files, ("0", "0", "1"), strict=True):
        # More than RULE_GENERATIONS generations, so that there are offspring too.
        front.main(["--decisions", "600000", "--anew", "--seed", seed, "--output", str(file)])
    assert files[0].read_bytes() == files[1].read_bytes()
    assert json.loads(files[0].read_text())["policies"] != json.loads(files[2].read_text())["policies"]


def test_a_front_is_replaced_by_a_larger_one_and_kept_otherwise(
    shipped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert front.main(SMALL) == 0
    first = shipped.read_bytes()
    assert "policies written to" in capsys.readouterr().out
    assert front.main(["--decisions", "0", "--anew"]) == 0
    assert "nothing is written" in capsys.readouterr().out
    assert shipped.read_bytes() == first
    assert front.main(["--decisions", "3000000", "--seed", "7"]) == 0
    assert "policies written to" in capsys.readouterr().out
    sources = {policy.source for policy in read_front(shipped.read_text(encoding="utf-8"))}
    assert any("--seed 7" in source for source in sources)


def test_a_run_of_another_scenario_or_action_set_is_refused(shipped: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(front.main, "--scenario", "static_obstacle", "--decisions", "0", "--from", RUN) == 2
    assert "has scenario = 'one_waypoint'; the front needs 'static_obstacle'" in capsys.readouterr().err
    assert exit_code(front.main, "--action-type", "continuous", "--decisions", "0", "--from", RUN) == 2
    assert "has action_type = 'discrete'; the front needs 'continuous'" in capsys.readouterr().err
    assert exit_code(front.main, "--decisions", "0", "--from", "no/such/run") == 2
    assert "no/such/run" in capsys.readouterr().err
    assert not shipped.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenario", "intersection"], "invalid choice: 'intersection'"),
        (["--decisions", "-1"], "--decisions -1 must be at least 0"),
        (["--output", "/no/such/folder/front.json"], "'/no/such/folder' is not a directory"),
    ],
)
def test_bad_arguments_are_refused(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        front.main(arguments)
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [{}, {"objectives": ["jerk", "distance", "destination", "g_force"]}])
def test_policies_of_a_run_join_the_search(
    tmp_path: Path, make_run: Callable[..., Path], arguments: dict[str, Any]
) -> None:
    recording = record_run(str(make_run(**arguments)), "one_waypoint", "discrete", 3)
    settings = FrontSearchSettings(decisions=0, anew=True, episodes=3)
    improvement = improve_front(settings, tmp_path / "missing.json", [recording])
    sources = {policy.source for policy in improvement.policies}
    assert {source.split()[0] for source in sources} == {"run", "python"}
    assert settings.command([recording.name]) in sources
    assert settings.command([recording.name]).endswith(f"--anew --from {recording.name} --episodes 3")


def test_every_policy_of_a_front_acts_greedily_once_and_then_sampled(make_run: Callable[..., Path]) -> None:
    path = make_run("mo-deepdrive-static-obstacle-v0", algorithm="pcn", fixed_destination=True)
    agent = build(load_experiment(path / "config.yaml"), num_envs=1)
    agent.load(path / "checkpoint.safetensors", policy_only=True)
    policies = len(agent.conditions())
    greedy = record_run(str(path), "static_obstacle", "discrete", 0).sequences
    sampled = record_run(str(path), "static_obstacle", "discrete", 3).sequences
    assert len(greedy) == policies
    assert len(sampled) == 4 * policies
    for first, again in zip(greedy, sampled, strict=False):
        np.testing.assert_array_equal(first, again)
