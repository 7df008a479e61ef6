"""Action sequences of trained runs in the scenario of a best-known front, as starting points of the front search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from algorithms.agent import FrontAgent
from algorithms.runs.build import build
from algorithms.runs.config import find_environment
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.policy import drive
from mo_deepdrive.fronts.reference_fronts import front_config

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.policy import Policy


@dataclass(frozen=True)
class RunRecording:
    """What the policies of a run do in the scenario of a front.

    Attributes:
        name: the last three parts of the run's path.
        description: algorithm, seed and steps.
        sequences: one per episode, (t,) or (t, 3) environment actions.
    """

    name: str
    description: str
    sequences: list[NDArray[Any]]

    @property
    def source(self) -> str:
        """The run as the source of a policy of a front."""
        return f"run {self.name}: {self.description}"


def record_run(path: str, scenario: str, action_type: str, episodes: int, *, trust: bool = False) -> RunRecording:
    """Record a run's policies: every policy of a run that learnt a front, the one policy of any other.

    Args:
        path: of the run, or the name of one in the zoo.
        scenario: "one_waypoint" or "static_obstacle".
        action_type: "discrete", "discrete-16" or "continuous".
        episodes: of sampled actions of each policy, after one of greedy actions.
        trust: as for :meth:`Run.open`.
    """
    run = Run.open(path, trust=trust)
    settings = run.experiment.environment
    for name, expected, found in (
        ("scenario", scenario, find_environment(settings.id).kwargs.get("scenario")),
        ("action_type", action_type, settings.arguments.get("action_type", "discrete")),
    ):
        if found != expected:
            raise ValueError(f"run {path!r} has {name} = {found!r}; the front needs {expected!r}")
    agent = build(run.experiment, num_envs=1, guides=False)
    agent.load(run.checkpoint, policy_only=True)
    # The fixed scenario of the front, with the rewards that the run was trained on.
    arguments: dict[str, Any] = front_config(scenario, action_type).model_dump(mode="json", exclude={"scenario"})
    arguments |= {name: settings.arguments[name] for name in ("objectives", "cost_sign") if name in settings.arguments}
    sequences = []
    for sampled in (False, True):
        repeats = episodes if sampled else 1
        policy: Policy = agent
        num_envs = repeats
        if isinstance(agent, FrontAgent):
            conditions = np.repeat(agent.conditions(), repeats, axis=0)
            policy = agent.policies(conditions)
            num_envs = len(conditions)
        if num_envs:
            env = EnvAdapter(make_env(settings.id, num_envs, arguments))
            generator = torch.Generator(agent.device).manual_seed(0) if sampled else None
            sequences += record_episodes(policy, env, generator)
    training = run.experiment.training
    return RunRecording(
        name="/".join(run.path.absolute().parts[-3:]),
        description=f"{run.experiment.algorithm.name}, seed {training.seed}, {training.total_timesteps} steps",
        sequences=sequences,
    )


def record_episodes(policy: Policy, env: EnvAdapter, generator: torch.Generator | None) -> list[NDArray[Any]]:
    """The actions, (t,) or (t, 3) as the environment takes them, of the first episode of each of ``env``'s copies.

    Args:
        policy: whose actions.
        env: of one vehicle.
        generator: of sampled actions; None for greedy ones.
    """
    taken: list[NDArray[Any]] = []
    lengths = np.zeros(env.num_envs, dtype=np.int64)
    for actions, _, counted, _ in drive(policy, env, env.reset(0), generator):
        taken.append(env.environment_actions(actions))
        lengths += counted[:, 0]
    return [np.stack(taken)[:length, row] for row, length in enumerate(lengths)]
