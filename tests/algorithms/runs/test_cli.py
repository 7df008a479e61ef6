"""What the scripts share: arguments, their checks, and exit codes."""

from __future__ import annotations

import os
import sys
from argparse import Namespace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from algorithms.command_line import prepare_process
from algorithms.runs.cli import (
    PROCESS_DEFAULTS,
    RUN_OUTPUT,
    Command,
    evaluation_arguments,
    evaluation_options,
    exit_on_error,
    named_numbers,
    option,
)
from algorithms.runs.config import Experiment, make_experiment
from algorithms.runs.interrupts import DiskFull, Stopped
from mo_deepdrive.evaluation.splits import Split
from tests.helpers.short_runs import VALUES


@pytest.fixture
def experiment() -> Experiment:
    return make_experiment(VALUES)


def test_a_process_draws_without_a_display_unless_the_user_chose_one_for_rendering(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    environment, path = {"SDL_VIDEODRIVER": "x11", "MPLBACKEND": "module://matplotlib_inline.backend_inline"}, ["first"]
    monkeypatch.setattr(os, "environ", environment)
    monkeypatch.setattr(sys, "path", path)
    prepare_process(PROCESS_DEFAULTS)
    assert environment == PROCESS_DEFAULTS | {"SDL_VIDEODRIVER": "x11", "MPLBACKEND": "agg"}
    assert path == ["first", str(tmp_path)]


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("peers", ["--list", "--output", "x"], "--output has no effect beside --list"),
        ("peers", ["--list", "--seed", "3"], "--seed has no effect beside --list"),
        ("evaluate", ["one_waypoint_nonlinear-mo_ppo", "--stochastic"], "--stochastic has no effect beside no --video"),
        ("sweep", ["--output", "x", "--status", "--workers", "2"], "--workers has no effect beside --status"),
        ("study", ["--config", "studies/suite", "--tables", "--on", "ray"], "--on has no effect beside --tables"),
        ("study", ["--config", "studies/suite", "--verify", "--tasks", "K1"], "--tasks has no effect beside --verify"),
        ("explore", ["best-known/x", "--output", "x.html", "--seed", "3"], "no effect on best-known fronts"),
        ("suite", ["list", "--algorithm.gamma=1"], "unrecognized arguments: --algorithm.gamma=1"),
    ],
)
def test_an_option_without_effect_beside_another_one_is_refused(
    command: str, arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        code = import_module(f"algorithms.commands.{command}").main(arguments)
    except SystemExit as end:
        code = end.code
    assert code == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def parsed(*arguments: str, options: Any = (), takes_keys: bool = False) -> Namespace:
    """What a command gets from a command line."""
    return Command("name", "Text\n  as it is.", options, lambda _: 0, takes_keys=takes_keys).parse(arguments)


def choices(*arguments: str, episodes: int | None = None, split: Split | None = None) -> Namespace:
    """What a command that evaluates gets from a command line."""
    return parsed(*arguments, options=(*evaluation_options(episodes, split), option("--video", "FILE", "film it")))


def test_episodes_and_seed_are_those_of_the_command_line_or_the_experiment(experiment: Experiment) -> None:
    settings = experiment.evaluation
    assert evaluation_arguments(choices(), experiment) == (settings.final_episodes, 3_000_000)
    assert evaluation_arguments(choices(episodes=20), experiment) == (20, 3_000_000)
    given = choices("--episodes=7", "--seed=0", episodes=20, split="validation")
    assert evaluation_arguments(given, experiment) == (7, 0)
    given = choices("--split=validation")
    assert evaluation_arguments(given, experiment) == (settings.final_episodes, 2_000_000)
    given = choices("--split=test", split="validation")
    assert evaluation_arguments(given, experiment) == (settings.final_episodes, 3_000_000)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--episodes=0"], "--episodes 0 must be at least 1"),
        (["--episodes=2001"], "--episodes = 2001 exceeds the 2,000 scenarios of the test split"),
        (["--seed=-1"], "--seed -1 must be between 0 and 2147483647"),
        (["--seed=2147483648"], "--seed 2147483648"),
        (["--video=a.txt"], r"--video 'a\.txt' must end in \.mp4"),
        (["--video=nowhere/a.mp4"], "--video 'nowhere/a.mp4': .*nowhere' is not a directory"),
    ],
)
def test_arguments_of_an_evaluation_are_checked(experiment: Experiment, arguments: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        evaluation_arguments(choices(*arguments), experiment)


def test_a_video_of_an_environment_without_frames_is_refused_before_the_evaluation(examples: None) -> None:
    experiment = make_experiment(
        {
            **VALUES,
            "environment": {"id": "commute:commute-v0"},
            "utility": {"name": "linear", "arguments": {"weights": [1, 1]}},
        }
    )
    with pytest.raises(ValueError, match=r"--video 'a\.mp4': environment 'commute:commute-v0' cannot be rendered"):
        evaluation_arguments(choices("--video=a.mp4"), experiment)


@pytest.mark.parametrize(
    ("arguments", "output", "rest"),
    [
        (["--output=~/a"], "HOME/a", []),
        (["--output", "~/a"], "HOME/a", []),
        (["--a.b=~/c", "--a.d=~", "--a.e", "~"], None, ["--a.b=HOME/c", "--a.d=~", "--a.e", "~"]),
        (["--output=a~/~"], "a~/~", []),
    ],
)
def test_a_tilde_before_a_slash_is_the_home_directory(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], output: str | None, rest: list[str]
) -> None:
    monkeypatch.setenv("HOME", "HOME")
    options = parsed(*arguments, options=(RUN_OUTPUT,), takes_keys=True)
    assert (options.output, options.overrides) == (output, rest)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        (["d=1"], "--w 'd=1': unknown objective 'd'; known: a, b"),
        (["a"], "--w 'a' must be of the form a=NUMBER"),
        (["a=inf"], "must be of the form a=NUMBER"),
        (["a=x"], "must be of the form a=NUMBER"),
        (["a=1", "a=1"], "--w names 'a' twice"),
    ],
)
def test_what_is_not_a_named_number_is_refused(pairs: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        named_numbers("--w", pairs, ("a", "b"))


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ValueError("wrong"), 2, "error: wrong\n"),
        (Stopped("no permission"), 1, "error: no permission\nresume with: X\n"),
        (DiskFull("disk full"), 1, "error: disk full\nresume with: X\n"),
        (KeyboardInterrupt(), 130, "interrupted; resume with: X\n"),
    ],
)
def test_errors_end_a_script_with_a_message_and_a_code(
    capsys: pytest.CaptureFixture[str], error: BaseException, code: int, message: str
) -> None:
    with pytest.raises(SystemExit) as caught, exit_on_error(ValueError, hint="resume with: X"):
        raise error
    assert caught.value.code == code
    assert capsys.readouterr().err == message
