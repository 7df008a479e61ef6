"""Shared by the tests of the commands: a tiny experiment, and finished runs."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from tests.helpers.script_runs import DRIVING, FRONT, TIMEOUT, command, environment


@pytest.fixture
def driving(tmp_path: Path) -> Path:
    """The YAML file of a tiny experiment."""
    path = tmp_path / "driving.yaml"
    path.write_text(DRIVING)
    return path


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, made by a new process."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "driving.yaml").write_text(DRIVING)
    done = subprocess.run(
        command("train", "--config", "driving.yaml", "--output", "run"),
        capture_output=True,
        text=True,
        cwd=folder,
        env=environment(),
        timeout=TIMEOUT,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "run"


@pytest.fixture(scope="session")
def finished_front(load_script: Callable[[str], ModuleType], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("front")
    (folder / "front.yaml").write_text(FRONT)
    arguments = ["--config", str(folder / "front.yaml"), "--output", str(folder / "run")]
    assert load_script("train").main(arguments) == 0
    return folder / "run"
