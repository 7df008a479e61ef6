"""What trains an experiment: an agent, or the agents of several seeds side by side, on one device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from algorithms import ALGORITHMS
from algorithms.device.trainer import SeedTrainer
from algorithms.device.worlds import SeedWorlds
from algorithms.experiments.build import MANY_ENVS, build, training_memory
from algorithms.experiments.config import find_environment, is_ours
from algorithms.experiments.registry import agent_class
from mo_deepdrive.machine import check_device, check_memory

if TYPE_CHECKING:
    from collections.abc import Sequence

    from algorithms.experiments.config import Experiment


def build_trainee(experiments: Sequence[Experiment]) -> Any:
    """What trains experiments that differ in their seeds alone, untrained.

    Returns:
        The agent of a single experiment, or a :class:`SeedTrainer` for several and for one that stays on its device.

    Raises:
        ValueError: if it cannot be built, or the experiments cannot be trained side by side.
    """
    first = experiments[0]
    if not first.is_resident and len(experiments) == 1:
        return build(first)
    check_resident(first)
    for each in experiments:
        if not each.is_resident or _shared(each) != _shared(first):
            raise ValueError("runs that are trained side by side must differ in training.seed alone")
    device, num_envs, count = torch.device(first.training.device), first.training.num_envs, len(experiments)
    check_device("training.device", str(device))
    if num_envs >= MANY_ENVS and device.type == "cpu":
        memory = count * training_memory(first, num_envs)
        check_memory(f"training.num_envs = {num_envs} of {count} seeds", memory)
    agents = [build(each, num_envs=1) for each in experiments]
    template = build(first, num_envs=1, device=str(device))
    try:
        worlds = SeedWorlds(
            template.env.vector_env.unwrapped.config, [agent.env_seed for agent in agents], num_envs, device
        )
        return SeedTrainer(agents, template, worlds, num_envs, compiled=bool(first.training.compiled))
    except torch.OutOfMemoryError:
        raise ValueError(
            f"training.num_envs = {num_envs} of {count} seeds do not fit into the memory of {device}; take fewer"
        ) from None


def _shared(experiment: Experiment) -> dict[str, Any]:
    """What experiments that are trained side by side have in common, as plain values."""
    values = experiment.to_dict()
    return {**values, "training": {**values["training"], "seed": None, "seeds": None}}


def check_resident(experiment: Experiment) -> None:
    """Refuse an experiment that cannot stay on its device.

    Raises:
        ValueError: naming what cannot.
    """
    training, name = experiment.training, experiment.algorithm.name
    key = "seeds" if training.device == "cpu" else "device"
    here = f"training.{key} = {getattr(training, key)!r}"
    if len(training.seeds or [0]) > 1:
        raise ValueError(f"training.seeds = {training.seeds}: mo-deepdrive train alone trains several side by side")
    if name not in ALGORITHMS or not agent_class(name).trains_on_devices:
        able = ", ".join(each for each in sorted(ALGORITHMS) if ALGORITHMS[each].trains_on_devices)
        raise ValueError(f"{here}: algorithm {name!r} trains on the CPU, one seed at a time; {able} can")
    if not is_ours(find_environment(experiment.environment.id)):
        raise ValueError(f"{here}: environment {experiment.environment.id!r} is another library's, on the CPU alone")
    if training.share_policy:
        raise ValueError(f"{here}: training.share_policy = True is for the CPU, one seed at a time; leave one out")
    for key in ("partners", "guides"):
        if drivers := getattr(training, key):
            raise ValueError(f"{here}: training.{key} = {list(drivers)} drive on the CPU alone; leave them out")
