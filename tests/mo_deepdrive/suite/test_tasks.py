"""The tasks as data: they can be made, their bounds are in order, their numbers do not change unnoticed."""

from __future__ import annotations

import re

import numpy as np
import pytest

from mo_deepdrive import suite
from mo_deepdrive.suite.scorers import SCORERS
from mo_deepdrive.world.config import parse_arguments
from mo_deepdrive.world.objectives import scales, signs

TASKS = suite.load().tasks


@pytest.mark.parametrize("name", TASKS)
def test_a_task_names_what_is_there(name: str) -> None:
    task = TASKS[name]
    config = task.config()
    assert config.charge_remaining_time
    assert "time" in task.objectives()
    assert task.score in SCORERS
    assert (task.utility is None) != (task.preferences is None)
    assert task.floor.value < task.ceiling.value
    for column in task.columns:
        arguments = {**config.model_dump(exclude={"scenario"}), **suite.load().perturbations[column]}
        assert parse_arguments(config.scenario, arguments) != config


def value_of(formula: str, values: dict[str, np.ndarray]) -> np.ndarray:
    """The value of a formula as tasks have them, by Python's own rules."""
    formula, *parts = formula.split(", ")
    for part in parts:
        name, _, text = part.partition(" = ")
        values = {**values, name: value_of(text, values)}
    formula = formula.replace(" + ", "  +  ").replace("[", "(").replace("]", ")")
    formula = re.sub(r"(?<=[\w)+]) (?=[\w(])", " * ", formula)
    while (text := re.sub(r"\(([^()]*)\)(\+?)", lambda m: f"{'positive' * bool(m[2])}<{m[1]}>", formula)) != formula:
        formula = text
    functions = {"positive": lambda x: np.maximum(x, 0.0), "exp": np.exp}
    return eval(re.sub("<(?!=)", "(", re.sub(">(?!=)", ")", formula)), {"__builtins__": {}}, {**values, **functions})


@pytest.mark.parametrize("name", TASKS)
def test_the_formula_of_a_task_is_its_utility(name: str) -> None:
    task = TASKS[name]
    assert bool(task.formula) == (task.rulebook is None)
    if task.rulebook is not None:
        return
    generator, objectives = np.random.default_rng(0), task.objectives()
    magnitudes = generator.uniform(0.0, 2.0, (1000, len(objectives))) * scales(objectives)
    values = dict(zip(objectives, magnitudes.T, strict=True))
    returns = magnitudes * signs(objectives)
    if task.preferences is None:
        utility = task.make_utility()(returns)
    else:
        known = task.preferences
        weights = known.weights(objectives)[0]
        common = [known.common.get(objective, 0.0) for objective in objectives]
        prices = dict(zip(objectives, weights - common, strict=True))
        values |= {f"p_{objective}": prices[objective] * unit for objective, unit in known.units.items()}
        utility = returns @ weights
    np.testing.assert_allclose(value_of(task.formula, values), utility, atol=2e-3)


def test_scores_are_normalised_between_floor_and_ceiling_and_cut_off_below_alone() -> None:
    task = TASKS["K3"]
    low, high = task.floor.value, task.ceiling.value
    np.testing.assert_allclose(
        task.normalised(np.array([low, high, 2 * high - low, low - 9 * (high - low)])), [0, 1, 2, -1]
    )


@pytest.mark.parametrize("name", [name for name, task in TASKS.items() if task.preferences])
def test_hidden_preferences_follow_from_their_seed(name: str) -> None:
    task = TASKS[name]
    assert task.preferences is not None
    weights = task.preferences.weights(task.objectives())
    count, left_out = task.preferences.count, task.preferences.left_out
    assert weights.shape == (count, len(task.objectives()))
    np.testing.assert_allclose(task.told_weights().sum(axis=1), 1.0)
    everything = task.preferences.model_copy(update={"left_out": [], "count": count + len(left_out)})
    drawn = everything.weights(task.objectives())
    np.testing.assert_array_equal(np.delete(drawn, task.preferences.left_out, axis=0), weights)


def test_an_unknown_task_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match="task 'K9' is unknown; known: K1, K3"):
        suite.load().task("K9")
