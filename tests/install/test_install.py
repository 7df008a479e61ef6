"""The sdist and the wheel as users get them: in new environments, and outside the checkout.

Packages are downloaded from pip's index. On Linux, ``PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu`` saves
the CUDA packages.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from algorithms import zoo
from algorithms.commands import COMMANDS
from tests.helpers.paths import REPOSITORY

pytestmark = pytest.mark.slow

TIMEOUT = 600
WRONG = "raise SystemExit('imported from the working directory')\n"
SHORT = ["--training.total_timesteps=4096", "--training.num_envs=16", "--evaluation.final_episodes=4"]
SHORT += ["--evaluation.episodes=2", "--utility.name=own_utility:utility"]
SWEEP = """
config: one_waypoint/mo_a2c_linear
overrides:
  training.total_timesteps: 2048
  training.num_envs: 16
  evaluation.episodes: 2
  evaluation.final_episodes: 2
  logging.save_figures: false
  utility.name: own_utility:utility
seeds: 2
"""
# Starts the command play, and presses Escape after ten frames.
PLAY = """
from algorithms.commands import play
from mo_deepdrive.drawing.quiet_pygame import pygame
shown = []
def flip():
    shown.append(True)
    if len(shown) == 10:
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE))
pygame.display.flip = flip
raise SystemExit(play.main(["--env", "mo-deepdrive-intersection-v0"]))
"""
ENVIRONMENTS = """
import gymnasium, mo_gymnasium, numpy, mo_deepdrive
for name in ("one-waypoint", "static-obstacle", "intersection"):
    env = mo_gymnasium.make(f"mo-deepdrive-{name}-v0", render_mode="rgb_array")
    env.reset(seed=0)
    assert numpy.asarray(env.step(env.action_space.sample())[1]).shape == env.unwrapped.reward_space.shape
    assert env.render().ndim == 3
    gymnasium.make_vec(f"mo-deepdrive-{name}-v0", num_envs=3).reset(seed=0)
mo_deepdrive.parallel_env().reset(seed=0)
print(len(mo_deepdrive.reference_front("one_waypoint")) > 10, mo_deepdrive.reference_point("one_waypoint").values.shape)
"""


@dataclass(frozen=True)
class Installed:
    """A virtual environment, and a folder to work in, which has packages of the project's names."""

    bin: Path
    folder: Path

    def run(self, program: str, *arguments: str, code: int = 0) -> subprocess.CompletedProcess[str]:
        """Run a program of the environment in the folder, and check its exit code."""
        kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
        done = subprocess.run(
            [str(self.bin / program), *arguments],
            cwd=self.folder,
            env={**kept, "SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy", "WANDB_MODE": "disabled"},
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )
        assert done.returncode == code, f"{program} {' '.join(arguments)}\n{done.stdout}\n{done.stderr}"
        return done

    def install(self, *packages: str) -> None:
        """Install packages in the tested versions, by the uv of ``make UV=uv``, which is faster, or by pip."""
        uv = shutil.which(os.environ.get("UV", ""))
        python = str(self.bin / "python")
        by_uv = [str(Path(uv or "").absolute()), "pip", "install", "--python", python]
        pip = by_uv if uv else [python, "-m", "pip", "install"]
        self.run(*pip, "--quiet", "--constraint", str(REPOSITORY / "constraints.txt"), *packages)

    def command(self, *arguments: str, code: int = 0) -> subprocess.CompletedProcess[str]:
        """Run ``mo-deepdrive``."""
        return self.run("mo-deepdrive", *arguments, code=code)


def make_environment(folder: Path) -> Installed:
    subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True, timeout=TIMEOUT)
    work = folder / "work"
    work.mkdir()
    return Installed(folder / "venv" / "bin", work)


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist, and the wheel that is built from it."""
    tools = make_environment(tmp_path_factory.mktemp("tools"))
    tools.install("build", "twine")
    output = tools.folder / "dist"
    tools.run("python", "-m", "build", "--outdir", str(output), str(REPOSITORY))
    assert sorted(path.suffix for path in output.iterdir()) == [".gz", ".whl"]
    checked = tools.run("twine", "check", "--strict", *map(str, output.iterdir())).stdout
    assert checked.count("PASSED") == 2, checked
    return output


@pytest.fixture(scope="module")
def core(dist: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel without extras."""
    installed = make_environment(tmp_path_factory.mktemp("installed"))
    (wheel,) = dist.glob("*.whl")
    installed.install(str(wheel))
    for name in ("algorithms", "mo_deepdrive"):
        (installed.folder / name).mkdir()
        (installed.folder / name / "__init__.py").write_text(WRONG)
    (installed.folder / "own_utility.py").write_text("def utility(returns):\n    return returns[..., 0]\n")
    (installed.folder / "sweep.yaml").write_text(SWEEP)
    return installed


@pytest.fixture(scope="module")
def everything(core: Installed, dist: Path) -> Installed:
    """The same environment with ``[train]``, and a run in the folder ``run``."""
    (wheel,) = dist.glob("*.whl")
    core.install(f"{wheel}[train]")
    said = core.command("train", "--config", "one_waypoint/mo_a2c_linear", "--output", "run", *SHORT).stdout
    assert "finished: run" in said
    return core


def test_the_metadata_have_the_readme_and_name_no_address_before_a_release(dist: Path) -> None:
    (sdist,) = dist.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        metadata = next(member for member in archive.getmembers() if member.name.endswith("/PKG-INFO"))
        file = archive.extractfile(metadata)
        assert file is not None
        text = file.read().decode()
    assert "\n# MO-DeepDrive\n" in text
    assert "Project-URL" not in text


def test_the_tests_pass_from_the_sdist(dist: Path, tmp_path: Path) -> None:
    """Those that read files of the project: documentation, configs, contracts, recorded trajectories."""
    (sdist,) = dist.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path)
    (source,) = tmp_path.iterdir()
    tests = ["test_architecture.py", "test_documentation.py", "mo_deepdrive/support/test_extras.py"]
    tests += ["mo_deepdrive/simulation", "algorithms/runs/test_config.py", "algorithms/studies/test_paper.py"]
    options = ["-q", "-m", "not slow", "--hypothesis-profile", "fast", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *(f"tests/{name}" for name in tests)],
        cwd=source,
        env={**os.environ, "PYTHONPATH": str(source)},
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-3000:]
    assert " passed" in done.stdout


def test_the_core_is_light_and_has_every_environment(core: Installed, tmp_path: Path) -> None:
    listed = core.run("python", "-m", "pip", "list", "--format=json").stdout
    packages = {each["name"].lower() for each in json.loads(listed)}
    assert len(packages - {"pip", "setuptools", "mo-deepdrive"}) <= 22, packages
    assert not packages & {"torch", "ray", "wandb", "matplotlib", "tensorboard", "polars", "rich"}
    assert Installed(core.bin, tmp_path).run("python", "-c", ENVIRONMENTS).stdout == "True (4,)\n"


def test_a_command_without_its_extra_says_what_to_install(core: Installed) -> None:
    refused = core.command("train", "--config", "one_waypoint/mo_a2c_linear", code=2)
    assert refused.stderr == "error: mo-deepdrive train needs torch: pip install --editable '.[train]'\n"
    listed = core.command("--help").stdout
    assert all(f"\n  {name} " in listed for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_of_the_core_prints_its_help_under_the_name_by_which_it_is_called(core: Installed, name: str) -> None:
    said = core.command(name, "--help").stdout
    assert said.startswith(f"usage: mo-deepdrive {name} ")
    assert "scripts/" not in said


def test_one_can_play_without_torch(core: Installed, tmp_path: Path) -> None:
    assert "vehicle 1: W A S D" in Installed(core.bin, tmp_path).run("python", "-c", PLAY).stdout


def test_a_run_is_trained_evaluated_drawn_and_tabulated(everything: Installed) -> None:
    run = everything.folder / "run"
    assert {"checkpoint.safetensors", "evaluation.json", "curves.png", "video.mp4", "tensorboard"} <= {
        path.name for path in run.iterdir()
    }
    assert "run is finished" in everything.command("train", "--resume", "run", "--trust").stdout
    assert "success" in everything.command("evaluate", "run", "--trust", "--episodes", "2").stdout
    everything.command("plot", "run", "--output", "curves.png")
    assert (everything.folder / "curves.png").stat().st_size > 10_000
    assert (
        "own_utility"
        in everything.command("table", "run", "--output", "table.csv").stdout
        + (everything.folder / "table.csv").read_text()
    )


def test_a_sweep_is_trained_by_workers(everything: Installed) -> None:
    assert "2 done" in everything.command("sweep", "--config", "sweep.yaml", "--output", "sweep").stdout
    everything.command("table", "sweep")
    shipped = everything.command("sweep", "--config", "sweeps/one_waypoint", "--on", "manifest", "--output", "grid")
    assert "40 runs" in shipped.stdout


def test_policies_of_the_zoo_come_with_the_wheel(everything: Installed) -> None:
    listed = everything.command("zoo").stdout
    assert all(f" {name} " in listed for name in zoo.names())
    chosen = everything.command("choose", "one_waypoint_front-pcn", "--weights", "distance=1", "--episodes", "1").stdout
    assert "chosen" in chosen
    everything.command("explore", "one_waypoint_front-pcn-printed", "--output", "explore.html")
    page = (everything.folder / "explore.html").read_text(encoding="utf-8")
    assert all(
        part in page for part in ("class Explorer", "class Parallel", "--series-0", '"one_waypoint_front-pcn-printed"')
    )


def test_other_libraries_and_the_reproduction_are_found_by_name(everything: Installed) -> None:
    assert ".[peers]" in everything.command("peers", "--list").stdout
    refused = everything.command("peers", "--config", "peers/envelope", code=2)
    assert "cannot run here: it needs morl_baselines: pip install --editable '.[peers]'" in refused.stderr
    refused = everything.command("reproduce", "--figure", "4", "--plan", "studies/pape", code=2)
    assert "the nearest names of shipped ones: studies/paper" in refused.stderr


def test_the_package_can_be_called_as_a_module(everything: Installed, tmp_path: Path) -> None:
    arguments = ["choose", "one_waypoint_linear-ppo", "--weights", "jerk=1"]
    refused = Installed(everything.bin, tmp_path).run("python", "-m", "mo_deepdrive", *arguments, code=2)
    assert "mo-deepdrive evaluate shows it" in refused.stderr
