"""The script for driving by hand, in an invisible window."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import imageio.v3 as iio
import pygame
import pytest

from algorithms.runs.build import build
from algorithms.runs.config import make_experiment
from algorithms.runs.run_directory import Run
from mo_deepdrive.play import FRAMES_PER_DECISION, HumanPlayEnv

ONE, TWO = "mo-deepdrive-one-waypoint-v0", "mo-deepdrive-intersection-v0"
ROUNDABOUT = "mo-deepdrive-roundabout-v0"


def make_run(path: Path, env_id: str = TWO, utility: str = "intersection_linear", **arguments: Any) -> Path:
    experiment = make_experiment(
        {
            "environment": {"id": env_id, "arguments": arguments},
            "utility": {"name": utility},
            "algorithm": {"name": "mo_a2c", "steps": 8, "hidden": [8], "learning_rate": 0.01},
            "training": {"total_timesteps": 128, "num_envs": 4},
        }
    )
    run = Run.create(experiment, path)
    agent = build(experiment)
    agent.train(experiment.training.total_timesteps)
    agent.save(run.checkpoint)
    run.unlock()
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "run", time_limit=3)


Typist = Callable[[dict[int, list[tuple[int, int]]]], None]
PRESS, RELEASE = pygame.KEYDOWN, pygame.KEYUP


@pytest.fixture(scope="module")
def play(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("play")


@pytest.fixture
def typing(monkeypatch: pytest.MonkeyPatch) -> Iterator[Typist]:
    """Press and release keys, by the number of frames shown before, in an invisible window."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")

    def type_keys(schedule: dict[int, list[tuple[int, int]]]) -> None:
        shown = 0

        def flip() -> None:
            nonlocal shown
            for kind, key in schedule.get(shown, ()):
                pygame.event.post(pygame.event.Event(kind, key=key) if key else pygame.event.Event(kind))
            shown += 1
            assert shown <= max(schedule) + 5, "the window should have closed by now"

        monkeypatch.setattr(pygame.display, "flip", flip)

    yield type_keys
    pygame.display.quit()


@pytest.mark.slow
def test_an_episode_in_the_window_ends_as_it_was_driven(
    play: ModuleType, typing: Typist, capsys: pytest.CaptureFixture[str]
) -> None:
    typing({0: [(PRESS, pygame.K_UP)], 60 * FRAMES_PER_DECISION: [(PRESS, pygame.K_ESCAPE)]})
    assert play.main(["--env", ONE, "--seed", "3", "--fps", "1000"]) == 0
    controls, title, names, units, _, row = [
        line.rstrip() for line in capsys.readouterr().out.splitlines() if line.strip()
    ]
    assert controls == "vehicle 0: arrow keys; R restarts the episode, Escape quits"
    assert title == "episode 1, seed 3"
    assert names.split() == ["end", "length", "distance", "destination", "g_force", "jerk"]
    assert units.split() == ["s", "m", "g", "m/s^3"]
    vehicle, end, seconds, *returns = row.split()
    assert (vehicle, end, float(seconds)) == ("vehicle_0", "backwards", 5.1)
    assert [float(value) < 0.0 for value in returns] == [True, False, True, True]
    assert not pygame.display.get_init()


def test_two_people_drive_at_one_keyboard(
    play: ModuleType, typing: Typist, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    environments: list[HumanPlayEnv] = []
    monkeypatch.setattr(
        "mo_deepdrive.play.HumanPlayEnv",
        lambda *args, **kw: environments.append(HumanPlayEnv(*args, **kw)) or environments[0],
    )
    typing(
        {
            0: [(PRESS, pygame.K_UP), (PRESS, pygame.K_w), (PRESS, pygame.K_a)],
            12 * FRAMES_PER_DECISION: [(pygame.QUIT, 0)],
        }
    )
    assert play.main(["--env", TWO, "--seed", "2", "--fps", "1000"]) == 0
    first, second = environments[0].vector_env.batch.state[0]
    assert first.speed > 0.8
    assert second.speed > 0.8
    assert first.heading == pytest.approx(first.start_heading, abs=1e-6)
    assert second.heading > second.start_heading + 0.1
    output = capsys.readouterr().out
    assert output.startswith("vehicle 0: arrow keys; vehicle 1: W A S D; R restarts the episode")
    assert "episode 1" not in output


@pytest.mark.slow
def test_an_episode_against_a_run_is_recorded(
    play: ModuleType, typing: Typist, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    decisions = 30 + 5
    typing({decisions * FRAMES_PER_DECISION: [(PRESS, pygame.K_ESCAPE)]})
    options = ["--against", str(run), "--vehicle", "1", "--stochastic", "--record", str(tmp_path / "drive.mp4")]
    assert play.main(["--env", TWO, "--fps", "1000", *options]) == 0
    out = capsys.readouterr().out
    rows = [line.split()[:3] for line in out.splitlines() if "vehicle_" in line]
    assert rows == [["vehicle_0", "time_limit", "3.0"], ["vehicle_1", "time_limit", "3.0"]]
    assert f"video: {tmp_path / 'drive.mp4'}: 3.5 s\n" in out
    assert len(iio.imread(tmp_path / "drive.mp4")) == decisions


def test_invalid_options_are_refused(
    play: ModuleType,
    run: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    single = make_run(tmp_path / "single", ONE, "one_waypoint_linear", time_limit=1)
    untrained = tmp_path / "untrained"
    untrained.mkdir()
    (untrained / "config.yaml").write_bytes((run / "config.yaml").read_bytes())

    def refused(*options: str) -> str:
        with pytest.raises(SystemExit, match="2"):
            play.main([*options])
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith("error: ")
        return captured.err

    among_rules = ("--env", ROUNDABOUT, "--against", "rule:balanced")
    assert "did you mean 'mo-deepdrive-intersection-v0'" in refused("--env", "mo-deepdrive-intersction-v0")
    assert "only this package's environments" in refused("--env", "minecart-v0")
    assert "not a run directory" in refused("--env", TWO, "--against", str(tmp_path))
    assert f"drives in {TWO}, not in {ONE}" in refused("--env", ONE, "--against", str(run))
    assert "no other vehicle" in refused("--env", ONE, "--against", str(single))
    assert "checkpoint.safetensors" in refused("--env", TWO, "--against", str(untrained))
    assert "--against RUN" in refused("--env", TWO, "--vehicle", "1")
    assert "--against RUN" in refused("--env", TWO, "--stochastic")
    assert "has 4 vehicles, and a keyboard has room for 2 people" in refused("--env", ROUNDABOUT)
    assert "--vehicle 4 must be between 0 and 3" in refused(*among_rules, "--vehicle", "4")
    assert "--seed -1" in refused("--env", TWO, "--seed", "-1")
    assert "--fps 0" in refused("--env", TWO, "--fps", "0")
    assert "nowhere" in refused("--env", TWO, "--record", str(tmp_path / "nowhere" / "drive.mp4"))


def test_without_a_display_the_error_says_what_is_missing(
    play: ModuleType, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonesuch")
    with pytest.raises(SystemExit, match="2"):
        play.main(["--env", ONE])
    error = capsys.readouterr().err
    assert error.startswith("error: cannot open a window")
    assert "DISPLAY" in error
    assert "nonesuch" in error


@pytest.mark.parametrize(("role", "seat"), [("strangers_0", 1), ("strangers_1", 0)])
def test_one_drives_the_vehicle_that_the_run_did_not_learn(
    play: ModuleType, typing: Typist, capsys: pytest.CaptureFixture[str], role: str, seat: int
) -> None:
    typing({2: [(PRESS, pygame.K_ESCAPE)]})
    against = ["--env", TWO, "--against", f"intersection_linear-mo_ppo-{role}", "--fps", "1000"]
    assert play.main(against) == 0
    assert f"vehicle {seat}: arrow keys" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        play.main([*against, "--vehicle", str(1 - seat)])
    message = f"--vehicle {1 - seat}: RUN learnt to drive vehicle_{1 - seat} alone; drive vehicle {seat}"
    assert message in capsys.readouterr().err


def test_one_drives_among_scripted_drivers(
    play: ModuleType, typing: Typist, capsys: pytest.CaptureFixture[str]
) -> None:
    typing({2: [(PRESS, pygame.K_ESCAPE)]})
    assert play.main(["--env", ROUNDABOUT, "--against", "rule:careful", "--vehicle", "2", "--fps", "1000"]) == 0
    assert "vehicle 2: arrow keys" in capsys.readouterr().out
