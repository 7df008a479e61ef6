"""From an experiment to its environment, its utilities and its agent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from algorithms.common.checkpoints import read_checkpoint
from algorithms.common.env_adapter import EnvAdapter, make_env
from algorithms.common.threads import set_threads
from algorithms.evaluation.front import check_reference_point
from algorithms.evaluation.metrics import vehicle_name
from algorithms.experiments.config import EnvironmentSettings, Experiment, UtilitySettings, find_environment, is_ours
from algorithms.experiments.registry import agent_class
from mo_deepdrive.names import nearest
from mo_deepdrive.utilities import Utility, check_utility, make_utility

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    from algorithms.experiments.run_directory import Run


def build(experiment: Experiment, num_envs: int | None = None) -> Any:
    """The untrained agent of an experiment, with its training environment.

    Args:
        experiment: what to build.
        num_envs: number of parallel environments; the experiment's if None.

    Returns:
        An instance of the algorithm's class, a subclass of :class:`algorithms.agent.Agent`.

    Raises:
        ValueError: if environment, utility and hyperparameters do not fit together.
    """
    algorithm = agent_class(experiment.algorithm["name"])
    set_threads(experiment.training.threads)
    env = make_environment(experiment.environment, num_envs or experiment.training.num_envs)
    adapter = EnvAdapter(env)
    options: dict[str, Any] = {}
    if experiment.utility is None:
        if adapter.vehicles > 1:
            raise ValueError(
                f"algorithm {experiment.algorithm['name']!r} learns a front, and a front has the returns of one "
                f"vehicle; {adapter.name} has {adapter.vehicles}"
            )
        check_reference_point(experiment.evaluation.reference_point, adapter.objectives)
    else:
        options["utility"] = _make_utilities(experiment.utility, adapter)
    return algorithm(
        env,
        **options,
        seed=experiment.training.seed,
        device=experiment.training.device,
        **experiment.hyperparameters,
    )


def load_policy(run: Run) -> Any:
    """The agent of a run with its trained policy and the number of steps that it has learnt from; it cannot train.

    Raises:
        ValueError: if the agent cannot be built, or the checkpoint cannot be read or does not fit it.
    """
    agent = build(run.experiment, num_envs=1)
    agent.load(run.checkpoint, policy_only=True)
    agent.step = int(read_checkpoint(run.checkpoint, {})[1]["step"])
    return agent


def make_environment(settings: EnvironmentSettings, num_envs: int) -> VectorEnv:
    """The environment of an experiment.

    Args:
        settings: its id and arguments.
        num_envs: number of parallel environments.

    Raises:
        ValueError: if it cannot be made with these arguments.
    """
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


def _make_utilities(settings: UtilitySettings, adapter: EnvAdapter) -> list[Utility]:
    """One utility per vehicle, each called as the algorithms will, so that it fails here and not after an hour."""
    vehicles = [vehicle_name(v) for v in range(adapter.vehicles)]
    for name in settings.vehicles:
        if name not in vehicles:
            raise ValueError(f"utility.vehicles has {name!r}; {nearest(name, vehicles)}")
    utilities = []
    for v in range(adapter.vehicles):
        choice = settings.of_vehicle(v)
        utility = make_utility(choice.name, adapter.objectives, cost_sign=adapter.cost_sign, **choice.arguments)
        for zeros in (np.zeros, torch.zeros):
            check_utility(utility, zeros)
        utilities.append(utility)
    return utilities
