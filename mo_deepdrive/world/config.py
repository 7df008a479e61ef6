"""Validated settings: the environment's configuration, and the base of all settings models."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args, get_origin

import pydantic
from pydantic import BaseModel, ConfigDict, Field

from mo_deepdrive.simulation.state import MAX_VEHICLES, NEAREST_CARS, SPENT_NAMES, YAW_FRICTION
from mo_deepdrive.support.names import nearest
from mo_deepdrive.support.plain_values import plain
from mo_deepdrive.world.objectives import INDEX
from mo_deepdrive.world.scenarios import SCENARIOS, Scenario, fit_problem

if TYPE_CHECKING:
    from collections.abc import Mapping

    from gymnasium.envs.registration import EnvSpec

ActionType = Literal["discrete", "discrete-16", "continuous"]
CostSign = Literal["maximise", "paper"]
# Parameters of make_utility that are no arguments of a utility.
SET_BY_ENVIRONMENT = ("name", "objectives", "cost_sign")
LONGEST = 300  # characters of a value in a message
Traffic = Literal["none", "light", "default", "dense"]


class Settings(BaseModel):
    """Base of every settings model: strict but for NumPy's numbers, immutable, and closed to unknown keys.

    A field is described by the string under it.
    """

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        ser_json_inf_nan="constants",
        use_attribute_docstrings=True,
    )

    @pydantic.model_validator(mode="before")
    @classmethod
    def _of_numpy(cls, values: Any) -> Any:
        """NumPy's numbers and arrays are as good as Python's, and tuples as lists."""
        values = plain(values)
        if not isinstance(values, dict):
            return values
        for name, value in values.items():
            if isinstance(value, (list, tuple)) and name in cls.model_fields:
                annotation = cls.model_fields[name].annotation
                kinds = [get_origin(member) for member in (annotation, *get_args(annotation))]
                values[name] = next((kind(value) for kind in kinds if kind in (list, tuple)), value)
        return values


S = TypeVar("S", bound=Settings)


def _settings_in(annotation: Any) -> Any:
    """The settings model, or dict, in the annotation ``X`` or ``X | None``; None if there is none."""
    members = [annotation] if get_origin(annotation) in (None, dict) else list(get_args(annotation))
    return next((member for member in members if get_origin(member) is dict or _is_model(member)), None)


def _is_model(annotation: Any) -> bool:
    # In Python 3.10 list[int] is an instance of type, too.
    return get_origin(annotation) is None and isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _model_at(model: Any, path: tuple[int | str, ...]) -> type[Settings] | None:
    """The settings model found by following ``path`` from ``model``."""
    for key in path:
        if get_origin(model) is dict:
            model = _settings_in(get_args(model)[1])
        elif _is_model(model) and key in model.model_fields:
            model = _settings_in(model.model_fields[str(key)].annotation)
        else:
            return None
    return model if _is_model(model) else None


def parse(model: type[S], values: Mapping[str, Any], what: str) -> S:
    """Build ``model`` from ``values``; a ValueError with every invalid key, its value and what is allowed."""
    try:
        return model.model_validate(dict(values))
    except pydantic.ValidationError as error:
        lines = []
        for problem in error.errors(include_url=False):
            path = problem["loc"]
            name = ".".join(str(part) for part in path)
            if problem["type"] == "extra_forbidden":
                owner = _model_at(model, path[:-1])
                lines.append(f"{name!r} is unknown; {nearest(str(path[-1]), owner.model_fields if owner else [])}")
            elif problem["type"] == "missing":
                lines.append(f"{name!r} is missing")
            else:
                value = repr(problem["input"])
                shown = value if len(value) <= LONGEST else f"{value[:LONGEST]}..."
                prefix = f"{name!r} = {shown}: " if path else ""
                lines.append(prefix + problem["msg"].removeprefix("Value error, "))
        raise ValueError(f"invalid {what}: " + "; ".join(lines)) from None


class EnvironmentSettings(Settings):
    """The environment of an experiment or a task."""

    id: str
    """A registered Gymnasium id with vector rewards; "module:id" imports the module first."""
    arguments: dict[str, Any] = {}
    """Keyword arguments of the environment."""


class UtilityChoice(Settings):
    """A utility, as the arguments of :func:`mo_deepdrive.utilities.make_utility`."""

    name: str
    """A registered utility, or "package.module:callable" for a custom one."""
    arguments: dict[str, Any] = {}
    """Its keyword arguments."""

    @pydantic.field_validator("arguments")
    @classmethod
    def _none_of_the_environment(cls, value: dict[str, Any]) -> dict[str, Any]:
        for name in SET_BY_ENVIRONMENT:
            if name in value:
                raise ValueError(f"{name!r} is set by the environment, or is not an argument")
        return value


class Rule(Settings):
    """A limit on what an objective costs in the mean over episodes, one rule of a rulebook."""

    objective: str
    """An objective that is a cost."""
    at_most: float = Field(gt=0.0)
    """The largest mean of its undiscounted magnitude per episode."""


def _once_each(rules: list[Rule]) -> list[Rule]:
    names = [rule.objective for rule in rules]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name!r} has {names.count(name)} rules; it must have one")
    return rules


# Rules in the order of their importance, the most important first (Censi et al. 2019).
Rulebook = Annotated[list[Rule], Field(min_length=1), pydantic.AfterValidator(_once_each)]


class EnvConfig(Settings):
    """Everything that determines an environment, apart from its seed."""

    scenario: str
    """Name of the scenario, a key of :data:`mo_deepdrive.world.scenarios.SCENARIOS`."""
    action_type: ActionType = "discrete"
    """The kind of actions, "discrete" (the paper's 22 actions), "discrete-16" or "continuous"."""
    fixed_destination: bool = False
    """The same destination in every episode (OneWaypoint, StaticObstacle)."""
    fixed_obstacle: bool = False
    """The same bicycles in every episode, with the same place along the route, length and angle (StaticObstacle)."""
    time_limit: float = Field(default=60.0, gt=0.0, le=3600.0)
    """Seconds after which an episode is truncated."""
    objectives: tuple[str, ...] | None = None
    """Names of the reward's objectives, in order; None for all of the scenario's."""
    cost_sign: CostSign = "maximise"
    """With "maximise" every cost is negated; with "paper" rewards are magnitudes."""
    simulation_frequency: int = Field(default=60, ge=1, le=1000)
    """Physics steps per second."""
    decision_frequency: int = Field(default=10, ge=1, le=1000)
    """Decisions per second; divides simulation_frequency."""
    constrain_controls: bool = False
    """Limit how fast steer and throttle change."""
    ignore_brake: bool = False
    """The brake has no effect."""
    harmful_g_force: float | None = Field(default=1.0, gt=0.0)
    """g-force above which the episode ends (g); None for never."""
    harmful_jerk: float | None = Field(default=None, gt=0.0)
    """Jerk above which the episode ends (m/s^3); None for never."""
    lane_margin: float = Field(default=0.0, ge=0.0, le=10.0)
    """Distance to the lane line below which lane violation counts (m)."""
    end_on_lane_violation: bool = False
    """End the episode more than 0.25 m outside the lane (Intersection, LeftTurn)."""
    yield_to_oncoming: bool = True
    """Progress of the left turn is negative while the other vehicle (Intersection) or an oncoming car on the map
    (LeftTurn) approaches."""
    end_together: bool = False
    """Both vehicles end when the first one ends, as in the published code (Intersection)."""
    charge_remaining_time: bool = False
    """Charge what remains of the time limit to the objective time, in the last reward of a vehicle that ends earlier
    without having arrived, whatever ended it (the end of the other vehicle, too), so that an early end costs as much
    time as standing still. A vehicle is charged nothing more where it arrives or reaches the time limit, or where a
    wrapper cuts the episode off; nor does the setting matter where time is not among the objectives."""
    spent: dict[str, float] = {}
    """How much of "g_force" (g), "jerk" (m/s^3) and "time" (s) may have been spent before an episode begins, by name.
    What has been is drawn uniformly between 0 and that, and charged in the first reward: who adds up rewards knows it
    from then on, and nobody observes it."""
    yaw_friction: float = Field(default=YAW_FRICTION, gt=0.0, lt=1.0)
    """By what the turn per physics step is multiplied at every step of 1/60 s; with more a car turns further for the
    same steering, and longer after it."""
    action_delay: int = Field(default=0, ge=0, le=100)
    """Decisions by which actions arrive late; until the first one arrives, a vehicle idles."""
    observed_cars: int = Field(default=NEAREST_CARS, ge=0, le=NEAREST_CARS)
    """How many of the nearest oncoming cars are observed; the others look as if there were none (LeftTurn)."""
    vehicles: int | None = Field(default=None, ge=2, le=MAX_VEHICLES)
    """How many vehicles there are, 2 to 16; None for the scenario's number (Roundabout)."""
    cars: int | None = Field(default=None, ge=0, lt=MAX_VEHICLES)
    """How many cars with scripted drivers join them; None for the scenario's number (Roundabout)."""
    traffic: Traffic = "default"
    """Flow of the oncoming cars, "none", or "light", "default" or "dense" with a mean headway of 9, 4.5 or 2.5 s
    (LeftTurn)."""

    @pydantic.field_validator("scenario")
    @classmethod
    def _known_scenario(cls, value: str) -> str:
        if value not in SCENARIOS:
            raise ValueError(f"is unknown; {nearest(value, SCENARIOS)}")
        return value

    @pydantic.field_validator("spent")
    @classmethod
    def _can_be_spent(cls, value: dict[str, float]) -> dict[str, float]:
        for name, most in value.items():
            if name not in SPENT_NAMES:
                raise ValueError(f"has {name!r}; {nearest(name, SPENT_NAMES)}")
            if most < 0.0:
                raise ValueError(f"{name} = {most} must be at least 0")
        return value

    @pydantic.model_validator(mode="after")
    def _consistent(self) -> EnvConfig:
        if self.simulation_frequency % self.decision_frequency:
            raise ValueError(
                f"simulation_frequency = {self.simulation_frequency} must be a multiple of "
                f"decision_frequency = {self.decision_frequency}"
            )
        if round(self.time_limit * self.decision_frequency) < 1:
            raise ValueError(
                f"time_limit = {self.time_limit} must be at least one decision of 1/{self.decision_frequency} s"
            )
        if self.scenario_data.roads and (problem := fit_problem(self.scenario_data)):
            raise ValueError(problem)
        if self.objectives is not None:
            if not self.objectives or len(set(self.objectives)) != len(self.objectives):
                raise ValueError(f"objectives = {list(self.objectives)} must be one or more distinct names")
            for name in self.objectives:
                if name not in INDEX:
                    raise ValueError(
                        f"objectives has {name!r}; {nearest(name, INDEX)}; one of your own is registered by its "
                        "module, which an id of the form 'module:ID' imports"
                    )
        return self

    @property
    def scenario_data(self) -> Scenario:
        """The scenario, with as many vehicles and cars, and as much spent before, as the configuration says."""
        scenario = SCENARIOS[self.scenario]
        number = scenario.number if self.vehicles is None else self.vehicles
        spent = {**dict(zip(SPENT_NAMES, scenario.spent, strict=True)), **self.spent}
        cars = scenario.cars if self.cars is None else self.cars
        return replace(scenario, number=number, cars=cars, spent=(spent["g_force"], spent["jerk"], spent["time"]))

    @property
    def physics_steps(self) -> int:
        """Physics steps per decision."""
        return self.simulation_frequency // self.decision_frequency

    @property
    def max_decisions(self) -> int:
        """Number of decisions after which an episode is truncated."""
        return round(self.time_limit * self.decision_frequency)


def parse_arguments(scenario: str, options: Mapping[str, Any]) -> EnvConfig:
    """The configuration of an environment from its keyword arguments.

    A ValueError with every invalid argument, its value and what is allowed; a TypeError, which says the same, if one is
    unknown, as Python raises it.
    """
    try:
        return parse(EnvConfig, {"scenario": scenario, **options}, "environment arguments")
    except ValueError as error:
        unknown = [name for name in options if name not in EnvConfig.model_fields]
        if unknown:
            raise TypeError(f"got an unexpected keyword argument {unknown[0]!r}; {error}") from None
        raise


def is_ours(spec: EnvSpec) -> bool:
    """Whether an environment belongs to this package, so that EnvConfig is its configuration."""
    return str(spec.vector_entry_point).startswith("mo_deepdrive.")
