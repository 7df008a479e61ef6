"""The tasks of the suite as data: what is driven, by what it is judged, and between which bounds a score lies.

``data/suite.yaml`` has them. A number there is part of a published result: whoever changes a task, a floor or a ceiling
raises the version.
"""

from __future__ import annotations

import functools
from importlib import resources
from typing import TYPE_CHECKING, Any, Literal

import gymnasium
import numpy as np
import yaml
from pydantic import Field

from mo_deepdrive.support.names import nearest
from mo_deepdrive.utilities import Utility, make_utility
from mo_deepdrive.world.config import (
    EnvConfig,
    EnvironmentSettings,
    Rulebook,
    Settings,
    UtilityChoice,
    parse,
    parse_arguments,
)
from mo_deepdrive.world.objectives import scales
from mo_deepdrive.world.params import chosen_objectives

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

DATA = resources.files("mo_deepdrive") / "data"
LOWEST = -1.0  # of normalised scores
Track = Literal["known utility", "unknown utility", "many vehicles"]
Kind = Literal["planned", "closed form", "best known"]
PolicyKind = Literal["greedy", "stochastic"]


class Bound(Settings):
    """A score that normalised scores are measured from."""

    value: float
    """The score."""
    by: str
    """What earns it, and on which scenarios."""


class Ceiling(Bound):
    """The score that counts as 1."""

    kind: Kind
    """Whether it was planned with the scenario known, follows from a formula, or is the best that is known."""


class HiddenPreferences(Settings):
    """Linear preferences that no learner is told before it is scored: prices of costs from a Dirichlet distribution."""

    count: int = Field(ge=1)
    """How many."""
    seed: int = Field(ge=0)
    """Seed of the drawing."""
    concentration: float = Field(gt=0.0)
    """Concentration of the distribution; below 1 favours few objectives."""
    common: dict[str, float]
    """Weights of returns on which all preferences agree, by objective."""
    units: dict[str, float]
    """By objective whose price is drawn, the magnitude of a return that costs 1 at a price of 1; prices sum to 1."""
    changes: tuple[float, float] | None = None
    """Between how many seconds a preference gives way to the next one, once in an episode; None for never."""
    left_out: list[int] = []
    """The drawn preferences, counted from 0, under which planned drives gain less than 0.1 over those for the mean."""

    def weights(self, objectives: Sequence[str]) -> NDArray[np.float64]:
        """(count, d) weights of undiscounted returns."""
        shape = np.full(len(self.units), self.concentration), self.count + len(self.left_out)
        prices = np.delete(np.random.default_rng(self.seed).dirichlet(*shape), self.left_out, axis=0)
        weights = np.tile([self.common.get(name, 0.0) for name in objectives], (self.count, 1))
        for (name, unit), price in zip(self.units.items(), prices.T, strict=True):
            weights[:, objectives.index(name)] += price / unit
        return weights

    def change_times(self) -> NDArray[np.float64]:
        """(count,) when each preference gives way to the next one (s)."""
        low, high = self.changes or (np.inf, np.inf)
        times = np.random.default_rng([self.seed, 1]).uniform(low, high, self.count + len(self.left_out))
        return np.delete(times, self.left_out) if self.changes else np.full(self.count, np.inf)


class Partners(Settings):
    """Scripted drivers of all vehicles but the one that is scored, which no learner has met; one at a time."""

    made_by: str
    """The function that makes one of its name and the action type, as "package.module:function"."""
    names: list[str]
    """Their names."""


class Lexicographic(Settings):
    """Rules in the order of their importance, and a cost that counts where none is broken."""

    rules: Rulebook
    """The rules."""
    then: str
    """The objective that counts after them, a cost."""
    worst: float
    """Its mean magnitude per episode that counts as 0, as does all that is worse."""
    best: float
    """That which counts as 1."""


class Task(Settings):
    """One task of the suite."""

    title: str
    """A few words."""
    tests: str
    """What it asks of a method, in a sentence."""
    formula: str = ""
    """The utility of an episode, in magnitudes of its objectives: [x <= 1] is 1 where that is so and else 0, (x)+ is
    the positive part, and p_time a preference's price of time. Empty where a rulebook judges."""
    ablation: str | None = None
    """The learner of the reference study that lacks what the task tests."""
    track: Track
    """The table that it belongs to."""
    core: bool = False
    """Whether it is one of the four that are tried first."""
    counted: bool = True
    """Whether it counts in a table over tasks."""
    environment: EnvironmentSettings
    """The environment."""
    utility: UtilityChoice | None = None
    """The utility, where it is known while learning."""
    preferences: HiddenPreferences | None = None
    """The preferences, where the utility is not known while learning."""
    rulebook: Lexicographic | None = None
    """What the scorer of that name judges by."""
    vehicle: int = 0
    """The vehicle whose driver is scored."""
    partners: Partners | None = None
    """Who drives the other vehicles when it is scored."""
    steps: int = Field(ge=1)
    """Environment steps that a learner may take."""
    episodes: int = Field(ge=1)
    """Episodes of the test split that a score is the mean of; with preferences or partners, of each of them."""
    score: str
    """The scorer, a key of :data:`mo_deepdrive.suite.scorers.SCORERS`."""
    policy: PolicyKind
    """Whether the greedy or the stochastic policy of a learner is the one that is ranked; the other is shown too."""
    columns: list[str] = []
    """The perturbations under which it is scored too, keys of :attr:`Suite.perturbations`."""
    floor: Bound
    """What the best rule or learner earns that is blind to what the task tests."""
    rule: Bound | None = None
    """What the best scripted driver, or a drive planned without what is tested, earns where that is neither bound."""
    ceiling: Ceiling
    """What counts as 1."""

    def normalised(self, score: Any) -> Any:
        """A score with the floor as 0 and the ceiling as 1; cut off at -1, and not above."""
        return np.maximum(LOWEST, (score - self.floor.value) / (self.ceiling.value - self.floor.value))

    def config(self) -> EnvConfig:
        """The configuration of the environment, with every default."""
        spec = gymnasium.spec(self.environment.id)
        own = {name: value for name, value in spec.kwargs.items() if name != "scenario"}
        return parse_arguments(spec.kwargs["scenario"], {**own, **self.environment.arguments})

    def differences(self, env_id: str, arguments: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
        """The values there and here of what differs in an environment of which all arguments are given."""
        of_task = self.config().model_dump(mode="json", exclude={"scenario"})
        needed = {"id": self.environment.id, **{f"arguments.{name}": value for name, value in of_task.items()}}
        given = {"id": env_id, **{f"arguments.{name}": value for name, value in arguments.items()}}
        return {name: (given.get(name), value) for name, value in needed.items() if given.get(name) != value}

    def objectives(self) -> tuple[str, ...]:
        """The names of the objectives of the environment's reward, in order."""
        return chosen_objectives(self.config())

    def make_utility(self) -> Utility:
        """The known utility, over the objectives of the environment; a ValueError if the task has none."""
        if self.utility is None:
            raise ValueError(f"the task {self.title!r} has no known utility")
        return make_utility(self.utility.name, self.objectives(), **self.utility.arguments)

    def hidden_weights(self) -> NDArray[np.float64]:
        """(P, d) weights of the undiscounted returns, one row per hidden preference; a ValueError if there are none."""
        if self.preferences is None:
            raise ValueError(f"the task {self.title!r} has no preferences")
        return self.preferences.weights(self.objectives())

    def told_weights(self) -> NDArray[np.float64]:
        """(P, d) hidden weights as policies are told them: of returns divided by nominal scales, and of sum 1."""
        weights = self.hidden_weights() * scales(self.objectives())
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))


class Suite(Settings):
    """All tasks."""

    version: int
    """Scores of different versions cannot be compared."""
    perturbations: dict[str, dict[str, Any]]
    """Arguments of the environment that no learner trains with, by the name of their column."""
    tasks: dict[str, Task]
    """The tasks by id."""

    def task(self, name: str) -> Task:
        """The task of an id; a ValueError if there is none."""
        if name not in self.tasks:
            raise ValueError(f"task {name!r} is unknown; {nearest(name, self.tasks)}")
        return self.tasks[name]


@functools.cache
def load() -> Suite:
    """The suite that comes with the package."""
    return parse(Suite, yaml.safe_load((DATA / "suite.yaml").read_text(encoding="utf-8")), "suite.yaml")
