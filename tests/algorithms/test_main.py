"""The command line: which commands there are, and whose packages they use."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from algorithms.commands import COMMANDS
from mo_deepdrive import __version__
from mo_deepdrive.__main__ import run


@pytest.fixture(autouse=True)
def _process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands change the environment and the path of their process."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("SDL_AUDIODRIVER", "dummy")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)


def called(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["mo-deepdrive", *words])
    try:
        return run()
    except SystemExit as end:
        return int(end.code or 0)


def test_help_lists_every_command_in_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(monkeypatch, "--help") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "usage: mo-deepdrive COMMAND ..."
    for name, what in COMMANDS.items():
        assert f"  {name:12}{what}" in lines
    assert max(map(len, lines)) < 100
    assert called(monkeypatch, "--version") == 0
    assert capsys.readouterr().out == f"mo-deepdrive {__version__}\n"


def test_an_unknown_command_is_refused_with_those_that_exist(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(monkeypatch, "trian") == 2
    error = capsys.readouterr().err
    assert "invalid choice: 'trian'" in error
    assert all(name in error for name in COMMANDS)
    assert called(monkeypatch) == 2


@pytest.mark.parametrize("script", ["train", "sweep"])
def test_the_scripts_for_users_are_the_commands(script: str, repository: Path, tmp_path: Path) -> None:
    words = [sys.executable, repository / "scripts" / f"{script}.py", "--help"]
    env = {**os.environ, "PYTHONPATH": str(repository)}
    done = subprocess.run(words, env=env, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.startswith(f"usage: mo-deepdrive {script} "), done.stderr


def test_a_command_whose_package_is_not_installed_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rich.box", None)
    monkeypatch.delitem(sys.modules, "algorithms.reporting.tables", raising=False)  # imported before
    assert called(monkeypatch, "zoo") == 2
    assert capsys.readouterr().err == "error: mo-deepdrive zoo needs rich: pip install --editable '.[train]'\n"


SWEEP = """
config: one_waypoint/mo_a2c_linear
overrides: {training.total_timesteps: 64, training.num_envs: 4, evaluation.episodes: 2, evaluation.final_episodes: 2,
  logging.save_figures: false}
seeds: 1
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    ["zoo", "sweep --config sweep.yaml --output sweep --workers 1"],
    ids=["in this process", "in workers"],
)
@pytest.mark.parametrize("installed", [False, True], ids=["a folder", "an installed package"])
def test_another_package_named_algorithms_is_no_obstacle(tmp_path: Path, words: str, installed: bool) -> None:
    place = tmp_path / "site-packages" if installed else tmp_path
    (place / "algorithms").mkdir(parents=True)
    (place / "algorithms" / "__init__.py").write_text("raise SystemExit('imported another package')\n")
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    done = subprocess.run(
        [sys.executable, "-m", "mo_deepdrive", *words.split()],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(place), os.environ.get("PYTHONPATH", "")])},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
