"""The worlds that the page ships, and how they drive on the CPU."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from algorithms.reporting.page.page import WORLDS
from algorithms.runs import web
from mo_deepdrive.world.batch import Draws, WorldBatch

FOLDER = Path(str(WORLDS))
PAGE = json.loads((FOLDER / web.PAGE).read_text())
NAMES = [world["name"] for world in PAGE["worlds"]]
SEED, DECISIONS = 3_000_005, 1000


def configuration(name: str) -> tuple[Any, Any]:
    """The facts of a shipped world, and its configuration."""
    facts = json.loads((FOLDER / f"{name}.json").read_text())
    return facts, web.configuration("world", facts["id"], facts["arguments"])


def random_actions(config: Any, decisions: int) -> np.ndarray:
    """Actions (decisions, 1, V) that are held for a while."""
    vehicles, choices = config.scenario_data.vehicles, len(WorldBatch(config, 1).table)
    drawn = np.random.default_rng(1).integers(0, choices, (decisions // 4, 1, vehicles))
    return np.repeat(drawn, 4, axis=0)


def numbers(records: np.ndarray, name: str = "") -> dict[str, np.ndarray]:
    """The numbers in an array of records, by field."""
    if records.dtype.names is None:
        return {name: records}
    fields = (numbers(records[each], f"{name}.{each}") for each in records.dtype.names if not each.startswith("gap_"))
    return {key: values for part in fields for key, values in part.items()}


def drive_on_cpu(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Actions (DECISIONS, V) at random, and records (DECISIONS,): observations, rewards and worlds after each decision.

    A world whose episode is over begins the next one.
    """
    _, config = configuration(name)
    batch, generator = WorldBatch(config, 1), np.random.default_rng(SEED)
    draws, actions = Draws(1, batch.scenario.draws, [generator]), random_actions(config, DECISIONS)
    arrays = {"observations": batch.observations, "rewards": batch.rewards, "worlds": batch.state}
    rows = np.zeros(DECISIONS, dtype=[(key, each.dtype, each.shape) for key, each in arrays.items()])
    episodes = 0
    batch.place(draws)
    for row, chosen in zip(rows, actions, strict=True):
        batch.step(chosen)
        for key, each in arrays.items():
            row[key] = each
        if batch.over().all():
            batch.place(draws)
            episodes += 1
    assert episodes > 1
    return actions[:, 0], rows


def check_drive(name: str, found: np.ndarray, expected: np.ndarray) -> None:
    """Assert that records of a drive are those of the CPU."""
    _, config = configuration(name)
    # A unit in the last place of float32.
    np.testing.assert_allclose(found["observations"], expected["observations"], rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(found["rewards"], expected["rewards"])
    there = numbers(found["worlds"])
    for field, values in numbers(expected["worlds"]).items():
        # exp and atan2 differ in their last digits; jerk is a difference of differences, per step of 1/60 s.
        least = 1e-12 * (config.simulation_frequency if field in (".jerk", ".objectives") else 1)
        np.testing.assert_allclose(there[field], values, rtol=1e-12, atol=least, err_msg=field)
