"""Fixtures: trained runs, and an empty zoo."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest
from rich.console import Console

from algorithms import zoo
from algorithms.runs.run_directory import Run
from tests.helpers.zoo import ACTOR_CRITICS, FRONTS, Trained, train


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """Trains the run of a kind once."""
    folder = tmp_path_factory.mktemp("runs")

    @functools.cache
    def get(kind: str) -> Run:
        return train({**ACTOR_CRITICS, **FRONTS}[kind](), folder / kind)

    return get


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty zoo instead of the package's."""
    folder = tmp_path / "zoo"
    folder.mkdir()
    monkeypatch.setattr(zoo, "ZOO", folder)
    return folder


@pytest.fixture(autouse=True)
def _wide_console(monkeypatch: pytest.MonkeyPatch) -> None:
    """A console that is wide enough for the tables of commands."""
    monkeypatch.setattr("algorithms.runs.console.make_console", lambda: Console(width=250))
