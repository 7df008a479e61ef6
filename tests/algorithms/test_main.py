"""The command line: mo-deepdrive, python -m mo_deepdrive and the scripts run the same commands."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from algorithms.commands import COMMANDS
from algorithms.runs.cli import as_called
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
        return run(None, "mo-deepdrive {}")
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


def test_messages_name_commands_as_they_were_called() -> None:
    text = "use mo-deepdrive train or mo-deepdrive sweep --verify; pip install 'mo-deepdrive[train]'"
    assert as_called(text, "mo-deepdrive {}") == text
    expected = "use python scripts/train.py or python scripts/sweep.py --verify; pip install 'mo-deepdrive[train]'"
    assert as_called(text, "python scripts/{}.py") == expected


@pytest.mark.slow
@pytest.mark.parametrize("program", ["python -m mo_deepdrive {}", "python scripts/{}.py"])
def test_help_and_errors_name_commands_as_they_were_called(program: str, repository: Path, tmp_path: Path) -> None:
    def start(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        _, *words = program.format(name).replace("scripts/", f"{repository}/scripts/").split()
        return subprocess.run(
            [sys.executable, *words, *arguments],
            env={**os.environ, "PYTHONPATH": str(repository)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )

    said = start("train", "--help").stdout
    assert said.startswith(f"usage: {program.format('train')} ")
    assert f"{program.format('train')} --resume runs/" in said
    assert "mo-deepdrive train" not in said
    refused = start("choose", "one_waypoint_linear-ppo", "--weights", "jerk=1")
    assert refused.returncode == 2
    assert f"{program.format('evaluate')} shows it" in refused.stderr


def test_a_command_whose_package_is_not_installed_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rich.box", None)
    monkeypatch.delitem(sys.modules, "algorithms.zoo.listing", raising=False)
    assert called(monkeypatch, "zoo") == 2
    assert capsys.readouterr().err == "error: mo-deepdrive zoo needs rich: pip install 'mo-deepdrive[train]'\n"


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
