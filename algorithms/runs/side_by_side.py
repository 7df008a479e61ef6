"""Several seeds at the same time, side by side on a GPU."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from algorithms import ALGORITHMS
from algorithms.runs.build import build
from algorithms.runs.config import find_environment, is_ours
from algorithms.runs.registry import agent_class
from mo_deepdrive.support.machine import check_device

if TYPE_CHECKING:
    from collections.abc import Sequence

    from algorithms.runs.config import Experiment


def build_trainee(experiments: Sequence[Experiment]) -> Any:
    """The untrained agent of experiments that differ in their seeds alone.

    Raises:
        ValueError: if it cannot be built, or the experiments cannot be trained side by side.
    """
    first = experiments[0]
    if len(seeds := first.training.seeds or []) > 1:
        raise ValueError(f"training.seeds = {seeds}: mo-deepdrive train alone trains several")
    if len(experiments) == 1 and not first.is_resident:
        return build(first)
    check_resident(first)
    for each in experiments[1:]:
        if _shared(each) != _shared(first):
            raise ValueError("runs that are trained side by side must differ in training.seed alone")
    device, num_envs = first.training.device, first.training.num_envs
    check_device("training.device", device)
    try:
        return build(first, seeds=[each.training.seed for each in experiments], device=device)
    except torch.OutOfMemoryError:
        raise ValueError(
            f"training.num_envs = {num_envs} of {len(experiments)} seeds do not fit into the memory of {device}; take "
            "fewer"
        ) from None


def _shared(experiment: Experiment) -> dict[str, Any]:
    """What experiments that are trained side by side have in common, as plain values."""
    values = experiment.to_dict()
    return {**values, "training": {**values["training"], "seed": None}}


def check_resident(experiment: Experiment) -> None:
    """Refuse an experiment that cannot be trained on a GPU.

    Raises:
        ValueError: naming what cannot.
    """
    name = experiment.algorithm.name
    here = f"training.device = {experiment.training.device!r}"
    if not agent_class(name).trains_on_devices:
        able = ", ".join(each for each in sorted(ALGORITHMS) if ALGORITHMS[each].trains_on_devices)
        raise ValueError(f"{here}: algorithm {name!r} trains on the CPU; {able} can")
    if not is_ours(find_environment(experiment.environment.id)):
        raise ValueError(f"{here}: environment {experiment.environment.id!r} is another library's, on the CPU alone")
