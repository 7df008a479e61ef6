"""Improving a best-known front: reproducible, and from the shipped front and trained runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import moocore
import numpy as np
import pytest

from mo_deepdrive.fronts.reference_fronts import GAMMA, front_config
from mo_deepdrive.fronts.reference_fronts import read as read_front
from mo_deepdrive.fronts.reference_points import reference_point
from mo_deepdrive.world.action_sequences import decode as decode_actions
from mo_deepdrive.world.action_sequences import discounted_sum
from mo_deepdrive.world.action_sequences import replay as replay_sequences
from scripts.bounds import front_search
from scripts.bounds.front_improvement import FrontSearchSettings, improve_front, shipped_front_file
from scripts.bounds.trained_runs import record_run


def replayed_returns(file: Path) -> np.ndarray:
    """The discounted returns of a file's policies in OneWaypoint, by replay."""
    policies = read_front(file.read_text(encoding="utf-8"))
    sequences = [decode_actions(policy.actions, "discrete") for policy in policies]
    return discounted_sum(replay_sequences(front_config("one_waypoint", "discrete"), sequences), GAMMA)


def test_fronts_are_shipped_where_the_package_reads_them() -> None:
    assert shipped_front_file("one_waypoint", "discrete").is_file()


@pytest.mark.slow
def test_the_same_seed_finds_the_same_front_and_another_seed_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(front_search, "POPULATION", 64)
    # More than RULE_GENERATIONS generations, so that there are offspring too.
    first, second, other = (
        improve_front(FrontSearchSettings(decisions=150_000, seed=seed), tmp_path / "missing.json")
        for seed in (0, 0, 1)
    )
    assert first == second
    assert first.policies != other.policies


@pytest.mark.slow
def test_progress_reaches_the_number_of_decisions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(front_search, "POPULATION", 64)
    calls: list[int] = []
    improve_front(FrontSearchSettings(decisions=50_000), tmp_path / "missing.json", on_progress=calls.append)
    assert calls == sorted(calls)
    assert calls[-1] >= 50_000 > calls[-2]


def test_a_search_of_no_decisions_keeps_the_shipped_front(tmp_path: Path) -> None:
    shipped = tmp_path / "shipped.json"
    improve_front(FrontSearchSettings(decisions=300_000), shipped).write(shipped)
    first = replayed_returns(shipped)
    improvement = improve_front(FrontSearchSettings(decisions=0), shipped)
    assert not improvement.loses_hypervolume
    improvement.write(shipped)
    second = replayed_returns(shipped)
    reference = reference_point().values
    volumes = [moocore.hypervolume(each, ref=reference, maximise=True) for each in (first, second)]
    assert volumes[1] == pytest.approx(volumes[0], rel=1e-9)


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
