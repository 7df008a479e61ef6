"""Exporting policies to the zoo."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from algorithms import zoo
from algorithms.runs.run_directory import Run
from algorithms.zoo.exporting import export
from tests.helpers.zoo import (
    ACTOR_CRITICS,
    Trained,
    contents,
)


def test_an_export_replaces_an_existing_policy(trained: Trained, home: Path) -> None:
    assert export(trained("pcn"), "policy") == home / "policy"
    assert zoo.names() == ["policy"]
    export(trained("a2c"), "policy")
    assert Run.open("policy").experiment == trained("a2c").experiment
    assert {path.name for path in home.iterdir()} == {"policy"}
    assert {path.name for path in (home / "policy").iterdir()} == {
        "config.yaml",
        "checkpoint.safetensors",
        "about.json",
    }


@pytest.mark.slow
@pytest.mark.parametrize("calls", [0, 3, 5, None])
@pytest.mark.parametrize("function", ["fsync", "replace"])
def test_a_failed_export_leaves_the_existing_policy_unchanged(
    trained: Trained, home: Path, monkeypatch: pytest.MonkeyPatch, function: str, calls: int | None
) -> None:
    """The call with index ``calls`` fails; with None, no call fails."""
    export(trained("a2c"), "policy")
    other = trained("pcn")  # before the failures: training writes, too
    before, real, made = contents(home), getattr(os, function), 0

    def full(*arguments: Any) -> None:
        nonlocal made
        made += 1
        if made - 1 == calls:
            raise OSError("No space left on device")
        real(*arguments)

    with monkeypatch.context() as context:
        context.setattr(os, function, full)
        try:
            export(other, "policy")
        except OSError:
            assert contents(home) == before
        else:
            assert calls is None or calls >= made
            assert Run.open("policy").experiment == trained("pcn").experiment
    assert [path.name for path in home.iterdir()] == ["policy"]


@pytest.mark.parametrize("name", ["", ".", "..", "../policy", "a/b", "Policy", ".policy", "-p", "a b", "__pycache__"])
def test_invalid_names_are_refused(trained: Trained, home: Path, name: str) -> None:
    with pytest.raises(ValueError, match=f"name {name!r} must be lower-case letters"):
        export(trained("a2c"), name)
    assert not list(home.iterdir())


def test_an_export_only_replaces_policies(trained: Trained, tmp_path: Path) -> None:
    run = trained("a2c")
    shutil.copytree(run.path, tmp_path / "run")
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder" / "deep").mkdir(parents=True)
    before = contents(tmp_path)
    for name in ("run", "file", "folder"):
        with pytest.raises(ValueError, match=f"{name}' is not a policy"):
            export(run, name, tmp_path)
    assert contents(tmp_path) == before


def test_a_run_without_a_policy_or_a_front_is_not_exported(trained: Trained, tmp_path: Path, home: Path) -> None:
    run = Run.create(ACTOR_CRITICS["a2c"](), tmp_path / "untrained")
    run.unlock()
    with pytest.raises(ValueError, match=r"checkpoint\.safetensors cannot be read"):
        export(run, "policy")
    shutil.copytree(trained("pcn").path, tmp_path / "unfinished")
    (tmp_path / "unfinished" / "front.csv").unlink()
    with pytest.raises(ValueError, match="unfinished' holds no front"):
        export(Run.open(tmp_path / "unfinished"), "policy")
    assert not list(home.iterdir())
