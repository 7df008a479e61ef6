"""From an experiment to its environment, its utilities and its agent; from names to drivers of single vehicles."""

from __future__ import annotations

import hashlib
import math
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch

from algorithms import ALGORITHMS
from algorithms.driving.named_rules import ScriptedPolicy, is_rule, scripted_policy
from algorithms.learning.checkpoints import read_checkpoint
from algorithms.learning.guides import Guide
from algorithms.learning.threads import set_threads
from algorithms.reporting.run_records import flatten
from algorithms.runs.config import Experiment, UtilitySettings, agent_class, check_loggers, find_environment
from algorithms.runs.run_directory import Run, imported_paths
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.front import check_reference_point
from mo_deepdrive.evaluation.metrics import joint_objectives, vehicle_name
from mo_deepdrive.evaluation.policy import check_same_task
from mo_deepdrive.evaluation.team import Population
from mo_deepdrive.support.machine import check_device, check_memory
from mo_deepdrive.support.names import nearest
from mo_deepdrive.utilities import Utility, check_utility, make_utility
from mo_deepdrive.world.config import is_ours

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from gymnasium.vector import VectorEnv

    from mo_deepdrive.evaluation.policy import Policy
    from mo_deepdrive.world.config import EnvironmentSettings


T = TypeVar("T")


def build(
    experiment: Experiment,
    num_envs: int | None = None,
    *,
    seeds: Sequence[int] | None = None,
    device: str = "cpu",
    partners: bool = True,
    guides: bool = True,
) -> Any:
    """The untrained agent of an experiment; ``partners`` and ``guides`` are needed by training alone."""
    algorithm, training = agent_class(experiment.algorithm.name), experiment.training
    num_envs = num_envs or training.num_envs
    if num_envs >= 10_000:  # of fewer ones it takes little
        check_memory(f"training.num_envs = {num_envs}", training_memory(experiment, num_envs))
    env = make_environment(experiment.environment, num_envs)
    adapter = EnvAdapter(env)
    options: dict[str, Any] = {}
    if experiment.utility is None:
        objectives = joint_objectives(adapter.objectives, adapter.vehicles)
        check_reference_point(experiment.evaluation.reference_point, objectives)
    else:
        options["utility"] = make_utilities(experiment.utility, adapter)
    for key, able, ability in (
        ("partners", algorithm.trains_with_partners, "train with partners"),
        ("guides", algorithm.trains_with_guides or not guides, "train with guides"),
        ("share_policy", algorithm.shares_policies, "share a policy"),
    ):
        if getattr(training, key) and not able:
            raise ValueError(f"training.{key}: algorithm {experiment.algorithm.name!r} cannot {ability}")
    if training.partners:
        options["partners"] = _partners(experiment, adapter, idle_only=not partners)
    if training.guides and guides:
        options["guides"] = [
            Guide(_population(f"guides.{name}", [guide.driver], v, adapter, experiment), guide, num_envs)
            for v, name, guide in _by_vehicle(training.guides, "training.guides", adapter)
        ]
    if training.share_policy:
        options["share_policy"] = True
    set_threads(training.threads)  # after the drivers', which are built like this
    return algorithm(
        env,
        **options,
        seed=seeds or training.seed,
        device=device,
        compiled=training.compiled,
        config=experiment.algorithm.config,
    )


def training_memory(experiment: Experiment, num_envs: int) -> float:
    """Bytes that a run takes at the least, a tenth less than was measured for A2C and PPO."""
    env = EnvAdapter(make_environment(experiment.environment, 1))
    config, arguments = experiment.algorithm.config, experiment.environment.arguments
    sample: float = 8 * env.observation_size + 24 * len(env.objectives) + 32
    if ":" in experiment.algorithm.name:  # a user's own, of which nothing is known
        steps = 1.0
    elif hasattr(config, "steps"):
        steps = config.steps
        sample += 12 * sum(config.hidden)  # activations of actor and critic
    else:  # whole episodes, of which the longest one of many random ones has at least 100 steps
        steps = min(100, arguments.get("time_limit", math.inf) * arguments.get("decision_frequency", 1))
    return num_envs * (800 + env.vehicles * steps * sample)


def load_policy(run: Run, *, partners: bool = True) -> Any:
    """The agent of a run with its trained policy and the number of steps that it has learnt from; it cannot train."""
    agent = build(run.experiment, num_envs=1, partners=partners, guides=False)
    agent.load(run.checkpoint, policy_only=True)
    agent.step = int(read_checkpoint(run.checkpoint, {})[1]["step"])
    return agent


def open_driver(name: str, vehicle: int, env: EnvAdapter, action_type: str, **permissions: Any) -> Policy:
    """What drives a vehicle: a run, a policy of the zoo, or a scripted driver, such as ``rule:gap_3``, by its name."""
    if is_rule(name):
        return scripted_policy(name, vehicle, env, action_type)
    run = Run.open(name, **permissions)
    if not run.experiment.known_utility:
        raise ValueError(f"{name!r} is a front of policies, not one that drives")
    if vehicle_name(vehicle) in run.experiment.training.partners:
        raise ValueError(f"{name!r} did not learn to drive {vehicle_name(vehicle)}")
    agent: Any = load_policy(run, partners=False)
    try:
        check_same_task(agent.env, env)
    except ValueError as error:
        raise ValueError(f"{name!r} cannot drive {vehicle_name(vehicle)}: {error}") from None
    return agent  # type: ignore[no-any-return]  # an algorithm of any class


def _population(key: str, drivers: Sequence[str], v: int, env: EnvAdapter, experiment: Experiment) -> Population:
    """Drivers that take turns in driving a vehicle of an experiment, which may import what its config names."""
    action_type = str(experiment.environment.arguments.get("action_type", "discrete"))
    imports = imported_paths(experiment.to_dict()).values()
    members, digests = [], []  # what identifies a driver wherever its files are: a script's name, a checkpoint's hash
    for name in drivers:
        try:
            driver = open_driver(name, v, env, action_type, imports=imports)
        except ValueError as error:
            raise ValueError(f"training.{key}: {error}") from None
        members.append(driver.alone(v) if isinstance(driver, ScriptedPolicy) else driver)
        checkpoint = b"" if is_rule(name) else Run.open(name, trust=True).checkpoint.read_bytes()
        digests.append(name if is_rule(name) else hashlib.sha256(checkpoint).hexdigest()[:16])
    return Population(members, v, digests)


def make_environment(settings: EnvironmentSettings, num_envs: int) -> VectorEnv:
    """The parallel environments of an experiment; a ValueError if they cannot be made with its arguments."""
    try:
        return make_env(settings.id, num_envs, settings.arguments)
    except ValueError:
        raise
    except Exception as error:
        if is_ours(find_environment(settings.id)):
            raise
        # Other packages' environments may raise anything, mostly because of their arguments.
        raise ValueError(
            f"environment {settings.id!r} with arguments {settings.arguments} cannot be made: "
            f"{type(error).__name__}: {error}"
        ) from error


def _partners(experiment: Experiment, adapter: EnvAdapter, *, idle_only: bool) -> dict[int, Population]:
    """What drives the vehicles that do not learn, by their indices; where it is not needed they do nothing."""
    partners, num_envs = experiment.training.partners, experiment.training.num_envs
    named = _by_vehicle(partners, "training.partners", adapter)
    if len(partners) == adapter.vehicles:
        raise ValueError(f"training.partners has drivers of all vehicles, {', '.join(partners)}: none is left to learn")
    for _, name, drivers in named:
        if not 1 <= len(drivers) <= num_envs:
            raise ValueError(
                f"training.partners.{name} must name at least one driver, and no more than training.num_envs = "
                f"{num_envs}; it has {len(drivers)}"
            )
    if idle_only:
        return {v: Population([ScriptedPolicy(adapter)], v, [""]) for v, _, _ in named}
    return {v: _population(f"partners.{name}", drivers, v, adapter, experiment) for v, name, drivers in named}


def _by_vehicle(section: Mapping[str, T], key: str, adapter: EnvAdapter) -> list[tuple[int, str, T]]:
    """The indices, names and entries of the vehicles in a section of the config."""
    vehicles = [vehicle_name(v) for v in range(adapter.vehicles)]
    for name in section:
        if name not in vehicles:
            raise ValueError(f"{key} has {name!r}; {nearest(name, vehicles)}")
    return [(vehicles.index(name), name, entry) for name, entry in section.items()]


def make_utilities(settings: UtilitySettings, adapter: EnvAdapter) -> list[Utility]:
    """One utility per vehicle, each called as the algorithms will, so that it fails here and not after an hour."""
    _by_vehicle(settings.vehicles, "utility.vehicles", adapter)
    utilities = []
    for v in range(adapter.vehicles):
        choice = settings.of_vehicle(v)
        utility = make_utility(choice.name, adapter.objectives, cost_sign=adapter.cost_sign, **choice.arguments)
        for zeros in (np.zeros, torch.zeros):
            check_utility(utility, zeros)
        utilities.append(utility)
    return utilities


def build_trainee(experiments: Sequence[Experiment]) -> Any:
    """The untrained agent of experiments that differ in their seeds alone."""
    first = experiments[0]
    check_loggers(first)
    if len(seeds := first.training.seeds or []) > 1:
        raise ValueError(f"training.seeds = {seeds}: mo-deepdrive train alone trains several")
    if len(experiments) == 1 and not first.is_resident:
        return build(first)
    check_resident(first)
    shared = [flatten(experiment.to_dict()) | {"training.seed": None} for experiment in experiments]
    if any(settings != shared[0] for settings in shared):
        raise ValueError("runs that are trained side by side must differ in training.seed alone")
    device = first.training.device
    check_device("training.device", device)
    try:
        return build(first, seeds=[experiment.training.seed for experiment in experiments], device=device)
    except torch.OutOfMemoryError:
        raise ValueError(
            f"training.num_envs = {first.training.num_envs} of {len(experiments)} seeds do not fit into the memory of "
            f"{device}; take fewer"
        ) from None


def check_resident(experiment: Experiment) -> None:
    """Refuse an experiment that cannot be trained on a GPU."""
    name = experiment.algorithm.name
    here = f"training.device = {experiment.training.device!r}"
    if not agent_class(name).trains_on_devices:
        able = ", ".join(other for other in sorted(ALGORITHMS) if ALGORITHMS[other].trains_on_devices)
        raise ValueError(f"{here}: algorithm {name!r} trains on the CPU; {able} can")
    if not is_ours(find_environment(experiment.environment.id)):
        raise ValueError(f"{here}: environment {experiment.environment.id!r} is another library's, on the CPU alone")
