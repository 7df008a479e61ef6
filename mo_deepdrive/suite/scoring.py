"""Scores of policies on the tasks of the suite."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.episodes import as_policy
from mo_deepdrive.evaluation.metrics import GREEDY, STOCHASTIC
from mo_deepdrive.evaluation.policy import AccruedReward, FunctionPolicy
from mo_deepdrive.evaluation.splits import SPLITS, first_seed
from mo_deepdrive.evaluation.statistics import Estimate, of_mean, resample
from mo_deepdrive.suite.results import Row, rounded
from mo_deepdrive.suite.scorers import SCORE, SCORERS, open_drives, policies_of, single
from mo_deepdrive.suite.tasks import load
from mo_deepdrive.support.importing import failure

if TYPE_CHECKING:
    from mo_deepdrive.suite.results import Samples
    from mo_deepdrive.suite.tasks import Task


def score(
    policy: Any,
    task_id: str,
    *,
    learner: str = "policy",
    seed: int = 0,
    episodes: int | None = None,
    first_episode: int | None = None,
    perturbed: bool = True,
    samples: Samples | None = None,
) -> list[Row]:
    """Score a policy on a task.

    Args:
        policy: an agent, or a function ``policy(observations, accrued, discounts) -> actions``, as
            :func:`mo_deepdrive.evaluation.evaluate` takes them, of accrued rewards that are not discounted; at the
            intersection it returns actions of both vehicles, of which those of the task's vehicle count. Where the
            utility is not known, also a list of them (a front, of which the best on the validation split is taken for
            each preference), a function of four arguments, the last of which are the weights (d,) of the preference,
            which sum to 1, of returns divided by the nominal scales of the objectives; or an object whose
            ``for_preference(weights)`` gives such a policy.
        task_id: of the task.
        learner: label of the rows.
        seed: by which the policy was trained, for the rows.
        episodes: E; the task's by default.
        first_episode: seed of the first episode; that of the test split by default.
        perturbed: also score it under the perturbations of the task.
        samples: to which those of the score of the policy that is ranked are added, by task, learner and seed, for
            :func:`mo_deepdrive.suite.write_samples`.

    Returns:
        The rows: of the policy that is ranked (an agent's greedy or stochastic one, as the task declares) and, for
        agents, the score of the other one.

    Raises:
        TypeError: for what cannot be called as a policy.
        ValueError: for an unknown task, or a policy that does not drive in the task's environment.
    """
    suite = load()
    task = suite.task(task_id)
    check_policy(policy, task_id)
    episodes = task.episodes if episodes is None else episodes
    start = first_seed("test" if first_episode is None else None, first_episode, episodes)
    scorer = SCORERS[task.score]
    kinds = [task.policy, *({GREEDY, STOCHASTIC} - {task.policy} if _is_agent(policy) else ())]
    rows = []
    for kind in kinds:
        ranked = kind == task.policy
        settings: dict[str, dict[str, Any]] = {SCORE: {}}
        if ranked and perturbed:
            settings |= {name: suite.perturbations[name] for name in task.columns}
        for name, arguments in settings.items():
            with open_drives(task, arguments, start, episodes, greedy=kind == GREEDY) as drives:
                collected = scorer.collect(drives, policy)
            part = scorer.part(task, collected)
            numbers = {name: of_mean(part, partial(scorer.score, task))}
            if name == SCORE and ranked:
                numbers |= {column: resample(collected, number(task)) for column, number in scorer.further.items()}
                details = scorer.details(task, collected) if scorer.details is not None else {}
                numbers |= {column: Estimate(value) for column, value in details.items()}
                if samples is not None:
                    samples[task_id, learner, seed] = rounded(part)
            for column, number in numbers.items():
                place = task_id, learner, seed, kind, column
                rows.append(Row(*place, number.value, number.low, number.high, version=suite.version))
    return rows


def _members(policy: Any, task: Task) -> list[Any]:
    """Policies that stand for a policy: those of a front, or that under the first preference."""
    found = policies_of(policy)
    if isinstance(found, list):
        return found
    d = len(task.objectives())
    try:
        return [found(np.full(d, 1.0 / d))]
    except (Exception, SystemExit) as error:  # a user's object may raise anything
        raise ValueError(f"the policy failed for weights ({d},): {failure(error)}") from error


def _is_agent(policy: Any) -> bool:
    """Whether a policy can act greedily or by sampling, as it is asked to."""
    if hasattr(policy, "for_preference"):
        return bool(getattr(policy, "samples", False))
    first = policy[0] if isinstance(policy, (list, tuple)) and policy else policy
    return isinstance(getattr(first, "env", None), EnvAdapter)


def check_policy(policy: Any, task_id: str) -> None:
    """Refuse a policy that cannot drive in a task, by one decision in two scenarios.

    A TypeError for what cannot be called as a policy; a ValueError, naming the task, for an agent of another one, a
    front where the utility is known, or actions of the wrong shape, type or range.
    """
    task = load().task(task_id)
    try:
        members = _members(policy, task)
        if not members:
            raise ValueError("the front has no policy")
        if task.utility is not None:
            single(policy)
        with open_drives(task, {}, SPLITS["validation"].start, 2, greedy=True) as drives:
            adapter = EnvAdapter(drives.env)
            actors = [as_policy(member, adapter) for member in members]  # before anything is compiled
            functions = [actor for actor in actors if isinstance(actor, FunctionPolicy)]
            if functions:
                observations = adapter.reset([drives.seed, drives.seed + 1])
            nothing = AccruedReward.begin(2, adapter.vehicles, len(adapter.objectives))
            for actor in functions:
                actor.act(observations, nothing, None)
    except (TypeError, ValueError) as error:
        raise type(error)(f"task {task_id}: {error}") from None
