"""Shared by all tests: the Hypothesis profile, the recorded trajectories, environments without wrappers."""

from __future__ import annotations

import importlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import hypothesis
import numpy as np
import pytest
import torch

import mo_deepdrive  # noqa: F401  (registers the ids)
from algorithms.commands import COMMANDS
from algorithms.learning.threads import set_threads
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES
from mo_deepdrive.world.scenarios import SCENARIOS
from tests.helpers.golden import FULL_SET, SAMPLE, Golden, is_complete, read_golden
from tests.helpers.paths import REPOSITORY
from tests.helpers.script_runs import Call, Done

hypothesis.settings.register_profile(
    "mo-deepdrive",
    derandomize=True,
    deadline=None,
    database=None,
    max_examples=60,
    suppress_health_check=[hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.filter_too_much],
)
# Of `make test-fast`.
hypothesis.settings.register_profile("fast", hypothesis.settings.get_profile("mo-deepdrive"), max_examples=8)
hypothesis.settings.load_profile("mo-deepdrive")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs a GPU where there is none; ``make test-gpu`` fails there."""
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="PyTorch finds no CUDA device"))


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    """Run torch on one thread: tests run in parallel, and its threads would compete for the cores."""
    before = torch.get_num_threads()
    set_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session", params=["sample", "full set"])
def golden(request: pytest.FixtureRequest) -> Golden:
    """Trajectories recorded from the original simulator: the sample in the repository, and the full set if present."""
    directory = SAMPLE if request.param == "sample" else FULL_SET
    if directory is FULL_SET and not is_complete(directory):
        pytest.skip(f"the full set of recorded trajectories is not in {directory}")
    return read_golden(request.param, directory)


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the repository."""
    return REPOSITORY


@pytest.fixture(scope="session")
def make_single() -> Callable[..., Any]:
    """Make the single environment of a scenario, without wrappers."""

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
    """Run a snippet in a new interpreter and return its output; the test fails if the snippet does."""

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
def load_script() -> Iterator[Callable[[str], ModuleType]]:
    """Import a command or a script by its name: ``main`` is what its command line runs. Each is imported once."""
    folder = REPOSITORY / "scripts"
    sys.path.append(str(folder))  # scripts find each other

    def load(name: str) -> ModuleType:
        if name in COMMANDS:
            return importlib.import_module(f"algorithms.commands.{name}")
        module_name = f"scripts_{name}"
        if module_name not in sys.modules:
            spec = importlib.util.spec_from_file_location(module_name, folder / f"{name}.py")
            assert spec is not None
            assert spec.loader is not None
            sys.modules[module_name] = importlib.util.module_from_spec(spec)
            try:
                spec.loader.exec_module(sys.modules[module_name])
            except BaseException:
                del sys.modules[module_name]
                raise
        return sys.modules[module_name]

    yield load
    sys.path.remove(str(folder))


@pytest.fixture
def call(
    load_script: Callable[[str], ModuleType],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> Call:
    """Call a script's ``main`` in the test's directory; exit code, standard output and standard error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("SDL_AUDIODRIVER", "dummy")

    def call(script: str, *arguments: Any) -> Done:
        capfd.readouterr()
        try:
            code = load_script(script).main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code
        captured = capfd.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.fixture
def registries() -> Iterator[None]:
    """Objectives, scenarios and ids that a test registers are forgotten afterwards."""
    objectives, index, scenarios = list(OBJECTIVES), dict(INDEX), dict(SCENARIOS)
    ids = dict(gymnasium.registry)
    yield
    OBJECTIVES[:] = objectives
    for table, before in ((INDEX, index), (SCENARIOS, scenarios), (gymnasium.registry, ids)):
        table.clear()
        table.update(before)


@pytest.fixture
def examples(registries: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The modules of docs/examples can be imported; they are not yet."""
    folder = REPOSITORY / "docs" / "examples"
    monkeypatch.syspath_prepend(folder)
    yield
    for path in folder.glob("*.py"):
        sys.modules.pop(path.stem, None)


WIDTH, LENGTH = 2.300675555555556, 5.17652


class Shapes:
    """Slow, simple geometry of convex shapes, independent of the package; a box is given by its four corners."""

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
        """Largest gap between the projections of two convex shapes (n, 2), by the separating axis theorem.

        The axes are the normals of all edges and, for segments and points, their directions. Positive where the shapes
        are apart, negative where they overlap.
        """
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
    """Slow, simple geometry with which the package's is compared."""
    return Shapes


def chase_waypoint(observation: np.ndarray) -> np.ndarray:
    """A continuous action (steer, acceleration, brake) that drives gently to the next waypoint."""
    angle, speed = float(observation[0]), float(observation[11])
    steer = np.clip(-angle, -1.0, 1.0) * 0.6 / max(1.0, speed) ** 2
    wanted = 3.0 if abs(angle) < 0.3 else 1.5
    return np.array([steer, np.clip(wanted - speed, -1.0, 1.0) * 0.6, -1.0], dtype=np.float32)


@pytest.fixture(scope="session")
def chase() -> Callable[[np.ndarray], np.ndarray]:
    """A policy for one vehicle that arrives if nothing is in its way."""
    return chase_waypoint
