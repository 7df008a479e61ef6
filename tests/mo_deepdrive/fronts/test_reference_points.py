"""Reference points: one for every scenario, action type and gamma, following the rules in the table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mo_deepdrive
from mo_deepdrive.world.objectives import INDEX, scales
from mo_deepdrive.world.scenarios import SCENARIOS

GAMMAS = (0.99, 1.0)


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("action_type", ["discrete", "discrete-16", "continuous"])
@pytest.mark.parametrize("gamma", GAMMAS)
def test_there_is_a_reference_point_for_every_scenario_and_action_type(
    scenario: str, action_type: str, gamma: float
) -> None:
    point = mo_deepdrive.reference_point(scenario, action_type, gamma)
    assert point.objectives == SCENARIOS[scenario].objectives
    assert point.values.shape == (len(point.objectives),)
    assert (point.values < 0.0).all()
    assert point.version >= 1
    assert all(f"{name}: " in point.reason for name in point.objectives)


def test_staying_is_a_tenth_of_a_scale_above_the_reference_point() -> None:
    for scenario in SCENARIOS:
        for gamma in GAMMAS:
            point = mo_deepdrive.reference_point(scenario, gamma=gamma)
            np.testing.assert_allclose(point.values[:2], -0.1 * scales(point.objectives[:2]))


@pytest.mark.parametrize("scenario", ["one_waypoint", "static_obstacle"])
@pytest.mark.parametrize("gamma", GAMMAS)
def test_comfort_is_measured_from_the_cost_of_random_actions(make_vector: Any, scenario: str, gamma: float) -> None:
    env = make_vector(scenario, 512, autoreset_mode="Disabled")
    env.reset(seed=0)
    batch, rng = env.batch, np.random.default_rng(0)
    costs, weight = np.zeros((512, len(env.objectives))), 1.0
    while not batch.over().all():
        batch.step(rng.integers(0, 22, (512, 1)))
        costs -= weight * batch.rewards[:, 0]
        weight *= gamma
    mean = dict(zip(env.objectives, costs.mean(axis=0), strict=True))
    point = mo_deepdrive.reference_point(scenario, gamma=gamma)
    limit = dict(zip(point.objectives, -point.values, strict=True))
    assert limit["g_force"] == pytest.approx(1.5 * mean["g_force"], rel=0.3)
    assert limit["jerk"] == pytest.approx(mean["jerk"], rel=0.2)


def test_a_gamma_without_a_reference_point_is_refused() -> None:
    with pytest.raises(ValueError, match=r"gamma = 0\.95 has no reference point; known: 0\.99, 1\.0"):
        mo_deepdrive.reference_point(gamma=0.95)


def test_the_documentation_has_every_reference_point(repository: Path) -> None:
    text = (repository / "docs" / "fronts.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    documented = {(title, row[1]): row[2:] for row in rows if row[1] in ("0.99", "1.0") for title in row[0].split(", ")}
    for scenario in SCENARIOS.values():
        for gamma in GAMMAS:
            numbers = dict(zip(INDEX, documented[scenario.title, str(gamma)], strict=True))
            point = mo_deepdrive.reference_point(scenario.name, gamma=gamma)
            assert [float(numbers[name]) for name in point.objectives] == point.values.tolist()
