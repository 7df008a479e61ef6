"""Scores of trained agents on the tasks of the suite."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from algorithms.agent import FrontAgent
from algorithms.runs.policy_evaluation import evaluate_front
from mo_deepdrive import suite
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import SUITE
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.support.atomic_io import write_json

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from algorithms.runs.config import Experiment
    from algorithms.runs.run_directory import Run
    from mo_deepdrive.evaluation.policy import Policy

CHOSEN_EPISODES = 20  # of the validation split, by which the policies of a front are chosen


@dataclass(frozen=True)
class PreferenceFollower:
    """A conditioned agent as a scorer takes it.

    Attributes:
        agent: told a linear preference, it acts by it.
        samples: whether its actions can be sampled.
    """

    agent: Any
    samples: bool = True

    def for_preference(self, weights: NDArray[np.float64]) -> Policy:
        """The policy under weights (d,) of returns divided by the nominal scales of the objectives."""
        env = self.agent.env
        own = weights * self.agent.scales / env.objective_scales
        condition = self.agent.preferences.condition("linear", dict(zip(env.objectives, own.tolist(), strict=True)))
        policy: Policy = self.agent.policy(condition)
        return policy


def scorable(agent: Any, experiment: Experiment) -> Any:
    """What :func:`mo_deepdrive.suite.score` takes of an agent.

    Args:
        agent: trained.
        experiment: that it was trained on, with the task that it is scored on.

    Returns:
        The agent itself for a known utility; what follows the hidden preferences, if it can be told them; else the
        policies of its front on the validation split.
    """
    if not isinstance(agent, FrontAgent):
        return agent
    task = suite.load().task(str(experiment.evaluation.task))
    if task.preferences is not None and hasattr(agent, "preferences"):
        return PreferenceFollower(agent)
    front = evaluate_front(agent, experiment, episodes=CHOSEN_EPISODES, seed=SPLITS["validation"].start)
    return [agent.policy(condition) for condition in front.conditions]


def score_run(run: Run, policy: Any) -> None:
    """Score a policy on the task of a run, and write the scores into its evaluation.json, as "greedy/suite/score".

    Perturbations are left out on the validation split, where settings are chosen.

    Args:
        run: with its final evaluation.
        policy: as of :func:`scorable`.

    Raises:
        ValueError: if the policy cannot drive in the task.
        OSError: if the scores cannot be written.
    """
    settings = run.experiment.evaluation
    rows = suite.score(
        policy, str(settings.task), first_episode=settings.final_seed, perturbed=settings.split == "test"
    )
    path = run.path / EVALUATION_FILE
    values = json.loads(path.read_bytes())
    for row in rows:
        found = values["policies"].setdefault(row.policy, {})
        found[SUITE + row.column] = {"value": row.value, "low": row.low, "high": row.high}
    write_json(path, {**values, "suite_version": suite.load().version})
