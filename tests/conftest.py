"""What every test module shares: the hypothesis profile, the recorded trajectories, environments without wrappers."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import hypothesis
import numpy as np
import pytest
import torch

import mo_deepdrive  # noqa: F401  (registers the ids)
from tests.helpers.paths import REPOSITORY

GOLDEN = REPOSITORY.parent / "shared" / "golden"

hypothesis.settings.register_profile(
    "mo-deepdrive",
    derandomize=True,
    deadline=None,
    database=None,
    max_examples=60,
    suppress_health_check=[hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.filter_too_much],
)
hypothesis.settings.load_profile("mo-deepdrive")


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    """Torch on one thread: tests run side by side, and its threads would wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@dataclass(frozen=True)
class Golden:
    """The recorded trajectories: episodes, each a list of one entry per vehicle, and the rows of all decisions."""

    episodes: dict[int, list[dict[str, Any]]]
    steps: dict[str, np.ndarray]

    def of(self, scenario: str) -> dict[int, list[dict[str, Any]]]:
        """The episodes of one scenario."""
        return {number: vehicles for number, vehicles in self.episodes.items() if vehicles[0]["scenario"] == scenario}


@pytest.fixture(scope="session")
def golden() -> Golden:
    """The recorded trajectories of the original simulator; tests that ask for them skip where they are absent."""
    if not (GOLDEN / "episodes.json").exists() or not (GOLDEN / "steps.npz").exists():
        pytest.skip(f"the recorded trajectories are not in {GOLDEN}")
    episodes: dict[int, list[dict[str, Any]]] = {}
    for entry in json.loads((GOLDEN / "episodes.json").read_text()):
        episodes.setdefault(entry["episode"], []).append(entry)
    with np.load(GOLDEN / "steps.npz") as arrays:
        steps = {name: arrays[name] for name in arrays.files}
    return Golden(episodes, steps)


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the repository."""
    return REPOSITORY


@pytest.fixture(scope="session")
def make_single() -> Callable[..., Any]:
    """Make the single environment of a scenario ("one_waypoint" or "static_obstacle") without any wrapper."""

    def make(scenario: str = "one_waypoint", **options: Any) -> Any:
        name = f"mo-deepdrive-{scenario.replace('_', '-')}-v0"
        return gymnasium.make(name, disable_env_checker=True, **options).unwrapped

    return make


@pytest.fixture(scope="session")
def make_vector() -> Callable[..., Any]:
    """Make the native vector environment of a scenario."""

    def make(scenario: str = "one_waypoint", num_envs: int = 1, **options: Any) -> Any:
        name = f"mo-deepdrive-{scenario.replace('_', '-')}-v0"
        return gymnasium.make_vec(name, num_envs=num_envs, **options)

    return make


@pytest.fixture(scope="session")
def run_python() -> Callable[[str], str]:
    """Run a snippet in a fresh interpreter and return what it prints; it fails the test if it fails."""

    def run(snippet: str) -> str:
        paths = [str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
        done = subprocess.run(
            [sys.executable, "-c", snippet], capture_output=True, text=True, env=environment, timeout=120, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.fixture(scope="session")
def load_script() -> Callable[[str], ModuleType]:
    """Import a script by its name: ``main`` is what its command line runs. Each is imported once."""

    def load(name: str) -> ModuleType:
        module_name = f"scripts_{name}"
        if module_name not in sys.modules:
            spec = importlib.util.spec_from_file_location(module_name, REPOSITORY / "scripts" / f"{name}.py")
            assert spec is not None
            assert spec.loader is not None
            sys.modules[module_name] = importlib.util.module_from_spec(spec)
            try:
                spec.loader.exec_module(sys.modules[module_name])
            except BaseException:
                del sys.modules[module_name]
                raise
        return sys.modules[module_name]

    return load


WIDTH, LENGTH = 2.300675555555556, 5.17652


class Shapes:
    """Slow and plain geometry of convex shapes, independent of the package: a box is its four corners."""

    width = WIDTH
    length = LENGTH

    @staticmethod
    def box(x: float, y: float, heading: float) -> np.ndarray:
        """Corners (4, 2) of a vehicle: front left, front right, back right, back left."""
        ahead = np.array([-np.sin(heading), np.cos(heading)])
        right = np.array([np.cos(heading), np.sin(heading)])
        signs = ((1, -1), (1, 1), (-1, 1), (-1, -1))
        return np.array([[x, y] + a * LENGTH / 2 * ahead + r * WIDTH / 2 * right for a, r in signs])

    @staticmethod
    def gap(first: np.ndarray, second: np.ndarray) -> float:
        """Largest gap between the projections of two convex shapes (n, 2) on the normals (and, for segments and
        points, the directions) of all their edges: positive where they are apart, negative where they overlap."""
        axes = [np.array([1.0, 0.0]), np.array([0.0, 1.0])]
        for shape in (first, second):
            for edge in np.roll(shape, -1, axis=0) - shape:
                size = np.hypot(*edge)
                if size > 1e-12:
                    axes += [edge / size, np.array([-edge[1], edge[0]]) / size]
        gaps = []
        for axis in axes:
            a, b = first @ axis, second @ axis
            gaps.append(max(a.min() - b.max(), b.min() - a.max()))
        return max(gaps)


@pytest.fixture(scope="session")
def shapes() -> type[Shapes]:
    """Slow and plain geometry, to hold the package's against."""
    return Shapes


def chase_waypoint(observation: np.ndarray) -> np.ndarray:
    """A continuous action (steer, acceleration, brake) that drives gently to the next waypoint."""
    angle, speed = float(observation[0]), float(observation[11])
    steer = np.clip(-angle, -1.0, 1.0) * 0.6 / max(1.0, speed) ** 2
    wanted = 3.0 if abs(angle) < 0.3 else 1.5
    return np.array([steer, np.clip(wanted - speed, -1.0, 1.0) * 0.6, -1.0], dtype=np.float32)


@pytest.fixture(scope="session")
def chase() -> Callable[[np.ndarray], np.ndarray]:
    """A policy for one vehicle: it arrives where nothing stands in its way."""
    return chase_waypoint
