"""The table of peers."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import Any

import pytest

from algorithms.commands.peers import load_peer_experiment
from algorithms.peers import PEERS, Peer
from mo_deepdrive.utilities import make_utility
from tests.helpers.peers import fake_adapter, make_task


def test_every_peer_is_described_consistently() -> None:
    for name, peer in PEERS.items():
        assert name.partition(".")[0] == peer.path.partition(".")[0]
        assert set(peer.actions) <= {"discrete", "continuous"}
        assert peer.Config() == peer.Config(**peer.Config().model_dump())


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("morl_baselines.capql", {}, "supports continuous actions; the environment has discrete actions"),
        ("morl_baselines.envelope", {"arguments": {"action_type": "continuous"}}, "supports discrete actions"),
        ("morl_baselines.pgmorl", {"arguments": {"action_type": "continuous"}}, "2 to 3 objectives; the environment"),
        ("stable_baselines3.ppo", {}, "needs a known utility"),
        ("morl_baselines.pcn", {}, "has one environment: training.num_envs = 2 must be 1"),
        ("morl_baselines.pcn", {"env_id": "mo-deepdrive-intersection-v0", "arguments": {}}, "supports one vehicle"),
    ],
)
def test_an_unsupported_task_is_refused_with_the_reason(name: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PEERS[name].check(name, make_task(**changes))


def test_a_peer_that_learns_a_front_takes_no_utility() -> None:
    utility = make_utility("one_waypoint_linear", ("distance", "destination", "g_force", "jerk"))
    with pytest.raises(ValueError, match="learns a front; remove the section"):
        PEERS["morl_baselines.pcn"].check("morl_baselines.pcn", make_task(utility=utility))


def test_a_missing_peer_is_unavailable_with_the_error_of_its_import() -> None:
    peer = Peer("no_such_library.module:Class", fake_adapter, ("discrete",), "no-such-library")
    assert peer.unavailable_reason() == "ModuleNotFoundError: No module named 'no_such_library'"
    assert (
        replace(peer, path="json:Class").unavailable_reason()
        == "AttributeError: module 'json' has no attribute 'Class'"
    )
    assert replace(peer, path="json:loads").unavailable_reason() is None


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "--evaluation.interval=7",
            "evaluation.interval = 7 has no effect: algorithm 'stable_baselines3.ppo' is trained",
        ),
        ("--training.seeds=[0, 1]", r"training.seeds = \[0, 1\] has no effect"),
        ("--logging.checkpoint_interval=100", "logging.checkpoint_interval = 100 has no effect"),
    ],
)
def test_what_another_library_does_not_do_cannot_be_set(override: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_peer_experiment("peers/ppo", [override])


@pytest.mark.slow
def test_importing_the_table_does_not_import_the_libraries() -> None:
    code = (
        "import sys, algorithms.peers; print([m for m in ('morl_baselines', 'stable_baselines3') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
