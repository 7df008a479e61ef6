"""The policies that the package ships."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from typing import TYPE_CHECKING

import numpy as np
import pytest

from algorithms import zoo
from algorithms.evaluation.episodes import evaluate
from algorithms.evaluation.front import Front
from algorithms.experiments.build import make_environment
from algorithms.experiments.run_directory import Run
from algorithms.zoo.exporting import FILES, export
from tests.helpers.paths import REPOSITORY
from tests.helpers.zoo import (
    KILOBYTE,
    SHIPPED,
    Trained,
    policy_of,
)

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.slow
def test_the_policies_of_an_installed_package_are_found(trained: Trained, tmp_path: Path) -> None:
    pytest.importorskip("setuptools", minversion="77")
    source = tmp_path / "source"
    for name in ("algorithms", "mo_deepdrive"):
        shutil.copytree(REPOSITORY / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, source / name)
    for name, kind in (("one_waypoint-linear-a2c", "a2c"), ("one_waypoint-pcn", "pcn")):
        export(trained(kind), name, source / "algorithms" / "zoo")
    build_wheel = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build_wheel, str(tmp_path)], cwd=source, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    shutil.rmtree(source)
    expected = sorted({*zoo.names(), "one_waypoint-linear-a2c", "one_waypoint-pcn"})
    show = (
        "from algorithms import zoo; from algorithms.evaluation.front import Front; print(zoo.names());"
        "print(len(Front.read(zoo.find('one_waypoint-pcn'))), zoo.ZOO)"
    )
    done = subprocess.run(
        [sys.executable, "-c", show],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "installed")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    policies = len(Front.read(trained("pcn").path))
    assert done.stdout.splitlines() == [str(expected), f"{policies} {tmp_path / 'installed' / 'algorithms' / 'zoo'}"]


def test_the_zoo_has_only_policies() -> None:
    folders = {path.name for path in SHIPPED.iterdir() if path.is_dir()} - {"__pycache__"}
    assert folders == {*zoo.names()}


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo.names())
def test_a_shipped_policy_loads_and_acts(name: str) -> None:
    path = zoo.find(name)
    assert {file.name for file in path.iterdir()} <= FILES
    assert sum(file.stat().st_size for file in path.iterdir()) < 200 * KILOBYTE
    about = json.loads((path / "about.json").read_text())
    run = Run.open(name)
    assert about["seed"] == run.experiment.training.seed
    assert about["step"] > 0
    assert run.experiment.training.device == "cpu"
    agent = policy_of(path)
    policy = agent
    if not run.experiment.known_utility:
        front = Front.read(path)
        assert front.objectives == agent.env.objectives
        desired, horizon = agent.commands()
        known = {tuple(row) for row in np.column_stack([desired, horizon])}
        assert {tuple(row) for row in front.conditions.astype(np.float32)} <= known
        policy = agent.policy(front.conditions[-1])
    for greedy in (True, False):
        found = evaluate(policy, make_environment(run.experiment.environment, 1), episodes=1, seed=5, greedy=greedy)
        assert np.isfinite(found.returns).all()
        assert (found.lengths > 1).any()
    with pytest.raises(ValueError, match="holds the policy alone"):
        agent.load(run.checkpoint)
