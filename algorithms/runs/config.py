"""An experiment as data: typed YAML, command-line overrides, and every mistake reported before anything starts."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import gymnasium
import mo_gymnasium  # noqa: F401  (registers its ids)
from pydantic import BeforeValidator, Field, SerializationInfo, SerializerFunctionWrapHandler, model_serializer

import mo_deepdrive
from algorithms import ALGORITHMS
from algorithms.hyperparameters import GuideSettings, a_twentieth
from mo_deepdrive.evaluation.metrics import vehicle_name
from mo_deepdrive.evaluation.splits import SPLITS, Split, check_episodes
from mo_deepdrive.support.atomic_io import expand_home
from mo_deepdrive.support.extras import EXTRAS
from mo_deepdrive.support.importing import import_module, import_named
from mo_deepdrive.support.machine import check_device
from mo_deepdrive.support.names import nearest, nearest_few
from mo_deepdrive.support.yaml import read_mapping, read_value
from mo_deepdrive.world.config import EnvConfig, EnvironmentSettings, Settings, UtilityChoice, is_ours, parse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from gymnasium.envs.registration import EnvSpec

    from mo_deepdrive.suite import Task

SHORT_FORMS = {"seed": "training.seed", "device": "training.device"}
T = TypeVar("T")


def _integer(value: Any) -> Any:
    """A float without a fraction as an integer, so that a million may be written as 1e6; 1.5 remains an error."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


Count = Annotated[int, Field(ge=1, le=10**15), BeforeValidator(_integer)]


class UtilitySettings(UtilityChoice):
    """The utility that is maximised."""

    vehicles: dict[str, UtilityChoice] = {}
    """Utilities of single vehicles that differ from it, by names such as "vehicle_1"."""

    def of_vehicle(self, v: int) -> UtilityChoice:
        """The utility of vehicle ``v``."""
        return self.vehicles.get(vehicle_name(v), self)


class TrainingSettings(Settings):
    """Length, seed and hardware of the training."""

    total_timesteps: Count
    """Environment steps, summed over the parallel environments."""
    num_envs: Annotated[int, Field(ge=1, le=1_000_000), BeforeValidator(_integer)]
    """Number of parallel environments."""
    seed: int = Field(default=0, ge=0, lt=2**31)
    """Seed of everything random in training."""
    seeds: Annotated[list[Annotated[int, Field(ge=0, lt=2**31)]], Field(min_length=1)] | None = None
    """Seeds of several runs that are trained at the same time, one process each on a CPU, side by side on a GPU; None
    for ``seed`` alone."""
    device: str = "cpu"
    """The device of the training, in PyTorch's notation; on a GPU worlds and learners stay there, and several ``seeds``
    take little longer than one."""
    threads: int = Field(default=1, ge=1, le=1024)
    """How many threads PyTorch uses; each needs a core of its own, or training becomes slower. A run is the same, bit
    for bit, for the same number."""
    compiled: bool | Literal["auto"] = "auto"
    """Whether gradient steps go through ``torch.compile``; the numbers are the same but for rounding. "auto" where a
    training is long enough to make up for the time that it takes, and a compiler is installed."""
    share_policy: bool = False
    """One policy that drives all vehicles, and learns from what all of them do, instead of one for each."""
    partners: dict[str, list[str]] = {}
    """What drives the vehicles that do not learn, by names such as "vehicle_1": runs, policies of the zoo and scripted
    drivers, which take turns over the parallel environments."""
    guides: dict[str, GuideSettings] = {}
    """What begins some episodes of vehicles that learn, by names such as "vehicle_1"; see GuideSettings."""


class EvaluationSettings(Settings):
    """How the policy is evaluated, independent of how it learns."""

    interval: Count | None = None
    """Environment steps between evaluations during training; None for a twentieth of the training."""
    episodes: Count = 100
    """Episodes per evaluation during training, which are the first ones of the validation split."""
    final_episodes: Count = 1000
    """Episodes of the evaluation at the end."""
    split: Split = "test"
    """The split of scenario seeds (:mod:`mo_deepdrive.evaluation.splits`) of the evaluation at the end; "validation"
    for runs that are compared in order to choose one."""
    gamma: float = Field(default=0.99, ge=0.0, le=1.0)
    """Discount of the reported discounted returns. If it is not given, a front of one of this package's environments
    with time among its objectives is undiscounted."""
    reference_point: list[float] | None = None
    """Reference point of a front's hypervolume, one number per objective; None for the default of this package's
    environments, and for no hypervolume on others."""
    task: str | None = None
    """The id of a task of the suite, as which the policy is scored, too, at the end."""
    follow_changes: bool = True
    """Tell the policy when a preference of the task changes; without it the first one is kept."""

    @model_serializer(mode="wrap")
    def _without_defaults_of_a_task(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        defaults = [("task", None), ("follow_changes", True)]
        return {key: value for key, value in serialise(self).items() if (key, value) not in defaults}

    @property
    def final_seed(self) -> int:
        """Seed of the first episode of the evaluation at the end."""
        return SPLITS[self.split].start


class WandbSettings(Settings):
    """Logging to Weights & Biases."""

    project: str
    """As in ``wandb.init``."""
    entity: str | None = None
    """As in ``wandb.init``."""
    group: str | None = None
    """As in ``wandb.init``."""
    tags: list[str] = []
    """As in ``wandb.init``."""
    mode: Literal["online", "offline"] = "online"
    """Either "online", which falls back to offline without an API key or network; or "offline"."""


class LoggingSettings(Settings):
    """What is written during training, besides metrics.csv and TensorBoard's event files."""

    interval: Count = 10
    """Updates between two rows of training metrics."""
    checkpoint_interval: Count | None = None
    """Environment steps between checkpoints; None for a twentieth of the training."""
    save_figures: bool = True
    """Draw the learning curves and the front, and film the policy, at the end."""
    wandb: WandbSettings | None = None
    """Log to Weights & Biases too; None to leave it out."""


class AlgorithmSettings(Settings):
    """An algorithm and its hyperparameters; in YAML both are in one section."""

    name: str
    """Name of the algorithm; "package.module:Class" for your own."""
    config: Any
    """Its hyperparameters, an instance of the algorithm's Config."""

    @model_serializer
    def _beside_the_name(self, info: SerializationInfo) -> dict[str, Any]:
        return {"name": self.name, **self.config.model_dump(mode=info.mode)}


class Experiment(Settings):
    """Everything that determines a training run; :func:`make_experiment` builds one and fills in every default."""

    environment: EnvironmentSettings
    """The environment to learn in."""
    utility: UtilitySettings | None = None
    """The utility to maximise; None for algorithms that learn a front."""
    algorithm: AlgorithmSettings
    """The algorithm and its hyperparameters."""
    training: TrainingSettings
    """Length, seed and hardware of the training."""
    evaluation: EvaluationSettings = EvaluationSettings()
    """How the policy is evaluated."""
    logging: LoggingSettings = LoggingSettings()
    """What is written during and after the training."""

    @property
    def known_utility(self) -> bool:
        """Whether the algorithm learns for a known utility, rather than a front for every utility."""
        return bool(find_algorithm(self.algorithm.name).known_utility)

    @property
    def is_resident(self) -> bool:
        """Whether worlds and learners stay on a GPU, with the seeds as an axis."""
        return self.training.device != "cpu"

    def of_seeds(self) -> list[Experiment]:
        """The experiments of the seeds, each that of a run of its own."""
        if self.training.seeds is None:
            return [self]
        trainings = [self.training.model_copy(update={"seed": s, "seeds": None}) for s in self.training.seeds]
        return [self.model_copy(update={"training": training}) for training in trainings]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, from which :func:`make_experiment` makes an equal experiment."""
        return self.model_dump(mode="json")


def load_experiment(path: str | Path, overrides: Sequence[str] = ()) -> Experiment:
    """Read an experiment from a YAML file, or from a shipped one by its name.

    Overrides are as on a command line, ``--section.key=value`` or ``--section.key value``, values as in YAML, with
    ``--seed`` and ``--device`` for those of the training section. A mapping is merged into the existing one. Of a key
    that is given more than once, the last value is used.
    """
    values = read_mapping(find_config(path))
    if "algorithm" not in values and (kinds := [kind for kind in ("config", "tasks") if kind in values]):
        kind = {"config": "sweep", "tasks": "study"}[kinds[0]]
        raise ValueError(f"{str(path)!r} is the file of a {kind}; mo-deepdrive {kind} --config {path} trains its runs")
    for key, value in parse_overrides(overrides):
        override(values, key, value)
    return make_experiment(values, f"experiment {str(path)!r}")


def make_experiment(values: Mapping[str, Any], name: str = "experiment", *, here: bool = True) -> Experiment:
    """Validate ``values``, which error messages call ``name``, and fill in every default.

    ``here`` is whether the experiment will run on this machine, which must then have its device.
    """
    problems: list[str] = []

    def attempt(check: Callable[..., T], *arguments: Any) -> T | None:
        try:
            return check(*arguments)
        except ValueError as error:
            problems.append(str(error))
            return None

    sections = dict(values)
    if isinstance(given := values.get("algorithm"), dict):
        # If it is refused, the other sections are checked nevertheless.
        sections["algorithm"] = attempt(_algorithm, given) or AlgorithmSettings(name="", config=Settings())
    experiment = parse(Experiment, sections, name)
    training, evaluation, logging = experiment.training, experiment.evaluation, experiment.logging
    environment, config = attempt(with_every_argument, experiment.environment) or (None, None)
    attempt(check_device, "training.device", training.device, here)
    attempt(_check_seeds, training)
    attempt(check_episodes, "evaluation.episodes", evaluation.episodes, "validation")
    attempt(check_episodes, "evaluation.final_episodes", evaluation.final_episodes, evaluation.split)
    if environment is not None:
        experiment = experiment.model_copy(update={"environment": environment})
        if evaluation.task is not None:
            attempt(check_task, experiment, evaluation.task)
        else:
            attempt(check_effects, experiment, ["evaluation.follow_changes"], "no task of the suite is scored")
    front = None
    if experiment.algorithm.name:
        attempt(_check_utility, experiment)
        if config is not None and not experiment.known_utility:
            front = attempt(_front_evaluation, evaluation, config)
    if problems:
        raise ValueError(f"invalid {name}: " + "; ".join(problems))
    default = a_twentieth(training.total_timesteps)
    if training.seeds is not None and training.seed not in training.seeds:
        training = training.model_copy(update={"seed": training.seeds[0]})
    return experiment.model_copy(
        update={
            "training": training,
            "evaluation": evaluation.model_copy(update={"interval": evaluation.interval or default, **(front or {})}),
            "logging": logging.model_copy(update={"checkpoint_interval": logging.checkpoint_interval or default}),
        }
    )


def parse_overrides(arguments: Sequence[str]) -> list[tuple[str, Any]]:
    """``["--a.b=1", "--seed", "3"]`` as ``[("a.b", 1), ("training.seed", 3)]``; see :data:`SHORT_FORMS`."""
    pairs: list[tuple[str, Any]] = []
    words = iter(arguments)
    for argument in words:
        key, equals, text = argument.removeprefix("--").partition("=")
        if not argument.startswith("--") or not all(key.split(".")):
            raise ValueError(f"argument {argument!r} is not of the form --section.key=value")
        if not equals and (text := next(words, "--")).startswith("--"):
            raise ValueError(f"argument {argument!r} has no value; write {argument}=VALUE")
        try:
            value = read_value(text)
        except ValueError as error:
            raise ValueError(f"argument --{key}: {error}") from None
        pairs.append((SHORT_FORMS.get(key, key), value))
    return pairs


def override(values: dict[str, Any], key: str, value: Any) -> None:
    """Set ``section.key`` in nested ``values``; a mapping is merged into the one there, an empty one clears it."""
    *sections, last = key.split(".")
    for depth, name in enumerate(sections):
        if values.get(name) is None:
            values[name] = {}
        values = values[name]
        if not isinstance(values, dict):
            raise ValueError(f"argument --{key}: {'.'.join(sections[: depth + 1])} = {values!r} is not a section")
    if value and isinstance(value, dict) and isinstance(values.get(last), dict):
        for name, inner in value.items():
            override(values[last], str(name), inner)
    else:
        values[last] = value


def with_every_argument(settings: EnvironmentSettings) -> tuple[EnvironmentSettings, EnvConfig | None]:
    """An environment with all of its arguments, and its configuration if it is one of this package's."""
    spec = find_environment(settings.id)
    if not is_ours(spec):
        return settings, None
    section = f"environment.arguments of {settings.id}"
    if "scenario" in settings.arguments:
        raise ValueError(f"invalid {section}: 'scenario' is set by the id; choose another id instead")
    config = parse(EnvConfig, {**spec.kwargs, **settings.arguments}, section)
    arguments = config.model_dump(mode="json", exclude={"scenario"})
    return settings.model_copy(update={"arguments": arguments}), config


def _algorithm(values: Mapping[str, Any]) -> AlgorithmSettings:
    if "name" not in values:
        raise ValueError(f"'algorithm.name' is missing; known: {', '.join(sorted(ALGORITHMS))}")
    name, rest = values["name"], {key: value for key, value in values.items() if key != "name"}
    config = parse(find_algorithm(name).Config, rest, f"hyperparameters of algorithm {name!r}")
    return AlgorithmSettings(name=name, config=config)


def _check_utility(experiment: Experiment) -> None:
    utility, learns = experiment.utility, f"algorithm {experiment.algorithm.name!r} learns"
    if experiment.known_utility:
        if utility is None:
            raise ValueError(f"'utility' is missing: {learns} for a known utility")
        check_effects(experiment, ["evaluation.reference_point"], f"{learns} one policy, not a front")
    elif utility is not None:
        raise ValueError(
            f"utility = {utility.name!r}: {learns} a front for every utility; leave the section out (mo-deepdrive "
            "choose applies a utility to the front)"
        )


def _front_evaluation(evaluation: EvaluationSettings, config: EnvConfig) -> dict[str, Any]:
    """The discount and the reference point of a front of this package's environments, where none are given."""
    if config.cost_sign != "maximise":
        raise ValueError(f"environment.arguments.cost_sign = {config.cost_sign!r}: a front needs 'maximise'")
    gamma, point = evaluation.gamma, evaluation.reference_point
    if "gamma" not in evaluation.model_fields_set:
        # As late as this, because they import the simulation.
        from mo_deepdrive.fronts.reference_fronts import default_discount
        from mo_deepdrive.world.params import chosen_objectives

        gamma = default_discount(chosen_objectives(config))
    # Of two vehicles the hypervolume of 64 policies would take hours.
    if point is None and config.scenario_data.vehicles == 1:
        try:
            default = mo_deepdrive.reference_point(config.scenario, config.action_type, gamma, config.objectives)
            point = default.values.tolist()
        except ValueError as error:
            raise ValueError(f"evaluation.reference_point must be given: {error}") from None
    return {"gamma": gamma, "reference_point": point}


def _check_seeds(settings: TrainingSettings) -> None:
    seeds = settings.seeds or [settings.seed]
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"training.seeds = {seeds} must differ from one another")
    if "seed" in settings.model_fields_set and settings.seed not in seeds:
        raise ValueError(f"training.seed = {settings.seed} must be one of training.seeds = {seeds}")


def check_task(experiment: Experiment, task_id: str) -> Task:
    """The task of the suite as which an experiment is scored, which was trained in its environment and no longer."""
    from mo_deepdrive import suite  # as late as this, because it imports the simulation

    task, environment = suite.load().task(task_id), experiment.environment
    differences = task.differences(environment.id, environment.arguments)
    if texts := [f"environment.{key} = {given!r} (not {needed!r})" for key, (given, needed) in differences.items()]:
        raise ValueError(f"task {task_id} needs another environment: {', '.join(texts)}")
    if (steps := experiment.training.total_timesteps) > task.steps:
        raise ValueError(
            f"training.total_timesteps = {steps:,}: task {task_id} allows {task.steps:,} environment steps"
        )
    if task.preferences is None or task.preferences.changes is None:
        check_effects(experiment, ["evaluation.follow_changes"], f"no preference of task {task_id} changes")
    return task


def check_effects(experiment: Experiment, keys: Iterable[str], why: str) -> None:
    """Refuse each of some keys, as "section.key", that has another value than its default."""
    for key in keys:
        section, _, name = key.partition(".")
        settings = getattr(experiment, section)
        value, default = getattr(settings, name), type(settings).model_fields[name].default
        filled_in = a_twentieth(experiment.training.total_timesteps) if default is None else default
        if value not in (default, filled_in):
            raise ValueError(f"{key} = {value!r} has no effect: {why}; leave it out")


def check_loggers(experiment: Experiment) -> None:
    """Refuse to train with a logger that is not installed; runs that had one can be evaluated without it."""
    if experiment.logging.wandb is not None and importlib.util.find_spec("wandb") is None:
        raise ValueError(f"logging.wandb needs wandb: pip install --editable '.[{EXTRAS['wandb']}]'")


# --------------------------------------------------------------------------------------------------------- named things

_PACKAGE = Path(__file__).resolve().parent.parent
# Within the package where it is installed from a wheel, beside the package in a checkout.
CONFIGS = next((path for path in (_PACKAGE / "configs", _PACKAGE.parent / "configs") if path.is_dir()), _PACKAGE)


def config_names() -> list[str]:
    """The names of the shipped YAML files, in alphabetical order: their paths in ``configs/`` without the ending."""
    return sorted(path.relative_to(CONFIGS).with_suffix("").as_posix() for path in CONFIGS.rglob("*.yaml"))


def find_config(name: str | Path, beside: str | Path | None = None) -> Path:
    """The YAML file that a user names: in the working directory or ``beside`` what names it, or else a shipped one."""
    path = expand_home(name)
    wanted, names = path.as_posix().removeprefix("configs/").removesuffix(".yaml"), config_names()
    candidates = [path] if beside is None else [path, Path(beside).parent / path]
    for candidate in (*candidates, *([CONFIGS / f"{wanted}.yaml"] if wanted in names else [])):
        if candidate.is_file():
            return candidate
    if path.exists():
        return path  # what is wrong with it is said by who reads it
    places = f" (looked for {' and '.join(map(str, candidates))})" if len({*map(Path.absolute, candidates)}) > 1 else ""
    near = nearest_few(wanted, names)
    raise ValueError(f"config file {str(name)!r} does not exist{places}; the nearest names of shipped ones: {near}")


def is_peer(name: str) -> bool:
    """Whether an algorithm is another library's, which the command peers trains."""
    return ":" not in name and name not in ALGORITHMS


def find_algorithm(name: object, source: str = "algorithm.name") -> Any:
    """An algorithm's class, or the entry of another library's, which has its ``known_utility`` and ``Config``, too."""
    if isinstance(name, str) and not is_peer(name):
        return agent_class(name)
    peers = resolve_name("algorithms.peers:PEERS")  # of a layer above this one
    if not isinstance(name, str) or name not in peers:
        hint = nearest(name, [*ALGORITHMS, *peers])
        raise ValueError(f"{source} = {name!r} is unknown; {hint}; or package.module:Class")
    return peers[name]


def agent_class(name: str) -> type[Any]:
    """The class of an algorithm, this project's or a user's, which is named by its path."""
    if name in ALGORITHMS:
        return ALGORITHMS[name]
    if is_peer(name):
        raise ValueError(f"algorithm {name!r} is another library's; mo-deepdrive peers runs it")
    from algorithms.agent import Agent, FrontAgent  # as late as this, because it imports torch

    algorithm, given = import_named("algorithm.name", name), f"algorithm.name = {name!r}"
    if not (isinstance(algorithm, type) and issubclass(algorithm, Agent)):
        raise ValueError(f"{given} must be a subclass of algorithms.Agent; it is {algorithm!r}")
    missing = {*algorithm.__abstractmethods__, *({"Config"} if not hasattr(algorithm, "Config") else ())}
    if missing:
        raise ValueError(f"{given} does not define {', '.join(sorted(missing))}")
    if not (algorithm.known_utility or issubclass(algorithm, FrontAgent)):
        raise ValueError(f"{given}: known_utility = False needs a subclass of algorithms.FrontAgent")
    if not (isinstance(algorithm.Config, type) and issubclass(algorithm.Config, Settings)):
        raise ValueError(f"{given}: Config = {algorithm.Config!r} must be a subclass of Settings")
    return algorithm


def peer_running() -> Any:
    """The module that trains other libraries' algorithms, of a layer above this one."""
    return resolve_name("algorithms.peers.running")


def directory_name(algorithm: str) -> str:
    """The name of an algorithm in names of directories: its name, or the class's where it is named by its path."""
    return algorithm.rpartition(":")[2]


def find_environment(env_id: str, source: str = "environment.id") -> EnvSpec:
    """The registered specification of ``env_id``, which may have the form "module:id"; ``source`` is its key."""
    module, _, name = env_id.rpartition(":")
    if ":" in module:
        raise ValueError(f"{source} = {env_id!r} must be an id, or of the form module:id")
    if module:
        import_module(f"{source} = {env_id!r}", module)
    if name not in gymnasium.registry:
        entry_points = {s.id: str(s.entry_point or s.vector_entry_point) for s in gymnasium.registry.values()}
        known = [name for name, path in entry_points.items() if path.startswith(("mo_deepdrive.", "mo_gymnasium."))]
        hint = "" if module else f"for one of your own write {f'module:{name}'!r}, which imports its module; "
        raise ValueError(f"{source} = {env_id!r} is not registered; {hint}{nearest(name, known)}")
    return gymnasium.registry[name]
