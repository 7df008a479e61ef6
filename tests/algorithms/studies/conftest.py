"""Fixtures: an experiment, the manifest of a sweep of it, and the scripts that show sweeps."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from types import ModuleType
from typing import Any

import pytest

from algorithms.studies.manifest import ManifestRow
from tests.helpers.made_up_sweeps import Script, config_of, make_row
from tests.helpers.script_runs import exit_code


@pytest.fixture(scope="session")
def base() -> dict[str, Any]:
    """A resolved experiment."""
    return config_of("one_waypoint/mo_a2c_linear")


@pytest.fixture
def grid(base: dict[str, Any]) -> list[ManifestRow]:
    """Six cells of three seeds."""
    rates, steps = (1e-4, 1e-3, 1e-2), (16, 32)
    cells = [{"algorithm.learning_rate": rate, "algorithm.steps": step} for rate, step in product(rates, steps)]
    return [make_row(base, cell, seed) for cell in cells for seed in range(3)]


@pytest.fixture
def table(load_script: Callable[[str], ModuleType]) -> Script:
    """Call mo-deepdrive table."""
    return lambda *arguments: exit_code(load_script("table").main, *arguments)


@pytest.fixture
def plot(load_script: Callable[[str], ModuleType]) -> Script:
    """Call mo-deepdrive plot."""
    return lambda *arguments: exit_code(load_script("plot").main, *arguments)
