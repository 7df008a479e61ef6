"""Fixtures: trained runs, an empty zoo, and the scripts."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from rich.console import Console

from algorithms import zoo
from algorithms.runs.run_directory import Run
from tests.helpers.zoo import (
    ACTOR_CRITICS,
    FRONTS,
    Call,
    Done,
    Trained,
    train,
)


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


@pytest.fixture(scope="session")
def scripts(load_script: Callable[[str], ModuleType]) -> dict[str, ModuleType]:
    """The scripts as modules."""
    return {name: load_script(name) for name in ("train", "evaluate", "choose", "play", "zoo")}


@pytest.fixture
def call(
    scripts: dict[str, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Call:
    """Run a script in the test's folder, with a console wide enough for its tables."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("algorithms.runs.console.make_console", lambda: Console(width=250))

    def call(script: str, *arguments: Any) -> Done:
        capfd.readouterr()
        try:
            code = scripts[script].main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code
        said = capfd.readouterr()
        return code, said.out, said.err

    return call
