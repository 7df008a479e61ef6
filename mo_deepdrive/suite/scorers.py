"""The scorers: what is measured of a policy's episodes in a task, and the numbers that are made of it.

A scorer drives and gives samples (E, ...), one row per scenario, and makes numbers of any resample of the rows, so that
every number has a bootstrap interval over the scenarios.
"""

from __future__ import annotations

import inspect
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import OUR_ENVS, as_policy, evaluate
from mo_deepdrive.evaluation.policy import FunctionPolicy, drive, seeded_generator
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.evaluation.team import Team
from mo_deepdrive.support.importing import import_named
from mo_deepdrive.utilities import RISK_AVERSE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from gymnasium.vector import VectorEnv
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.policy import AccruedReward, Policy, PolicyFunction
    from mo_deepdrive.suite.tasks import Task

    Single = Policy | PolicyFunction
    Statistic = Callable[[NDArray[np.float64]], float]

CHOICE_EPISODES = 50  # of the validation split, by which a policy of a front is chosen for a preference
TAIL = 0.1  # share of the worst episodes in CVaR10
SCORE, CVAR, WORST, CONTROLLABILITY = "score", "cvar10", "worst_family", "controllability"


@dataclass(frozen=True)
class Drives:
    """Where, and how, a policy is driven to be scored."""

    task: Task  #: the task
    env: VectorEnv  #: its environment, perhaps perturbed
    seed: int  #: of the first episode
    episodes: int  #: E
    greedy: bool  #: of agents, take the most likely (or mean) action instead of sampling

    def returns(self, policy: Single, partner: str | None = None) -> NDArray[np.float64]:
        """(E, d) undiscounted returns of the scored vehicle of every episode, perhaps with a partner of the task."""
        adapter = EnvAdapter(self.env)
        actor = as_policy(policy, adapter, gamma=1.0)
        greedy = self.greedy or isinstance(actor, FunctionPolicy)
        if (settings := self.task.partners) is not None and partner is not None:
            driver = import_named("partners.made_by", settings.made_by)(partner, self.task.config().action_type)

            def drive(observations: NDArray[Any], *_: Any) -> NDArray[Any]:
                actions: NDArray[Any] = driver(observations.reshape(-1, observations.shape[-1]))
                return actions.reshape(*observations.shape[:2], *actions.shape[1:])

            seats = np.arange(adapter.vehicles) != self.task.vehicle
            actor = Team([actor, FunctionPolicy(drive, adapter)], seats.astype(int).tolist())
        found = evaluate(actor, self.env, seed=self.seed, episodes=self.episodes, greedy=greedy, gamma=1.0)
        return found.returns[:, self.task.vehicle]

    def changing(
        self, before: Single, after: Single, weights: NDArray[np.float64], seconds: float
    ) -> NDArray[np.float64]:
        """(E,) the rewards of every episode, weighted by the first of ``weights`` (2, d) until ``seconds`` have passed.

        From then on the policy ``after`` acts, and the second weights count.
        """
        adapter, v = EnvAdapter(self.env), self.task.vehicle
        first = round(seconds * self.task.config().decision_frequency)
        policy = Changing(as_policy(before, adapter, gamma=1.0), as_policy(after, adapter, gamma=1.0), first)
        generator = (
            None if self.greedy or isinstance(policy.before, FunctionPolicy) else seeded_generator(policy, self.seed)
        )
        worth: list[NDArray[np.float64]] = []
        for start in range(self.seed, self.seed + self.episodes, adapter.num_envs):
            total = np.zeros(adapter.num_envs)
            observations = adapter.reset(list(range(start, start + adapter.num_envs)))
            for t, (_, step, counted, _) in enumerate(drive(policy, adapter, observations, generator)):
                total += counted[:, v] * (step.rewards[:, v] @ weights[int(t >= first)])
            worth.append(total)
        return np.concatenate(worth)[: self.episodes]


@dataclass(frozen=True)
class Changing:
    """A policy (:class:`mo_deepdrive.evaluation.policy.Policy`) that acts as another one from a decision on."""

    before: Policy
    after: Policy
    decision: int

    def __getattr__(self, name: str) -> Any:
        return getattr(self.before, name)

    def act(self, observations: NDArray[np.float32], past: AccruedReward, generator: Any) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o)."""
        later = bool((past.decisions >= self.decision).any())
        return (self.after if later else self.before).act(observations, past, generator)


def policies_of(policy: Any) -> Callable[[NDArray[np.float64]], Single] | list[Single]:
    """What a preference picks from: a function of the weights if the policy is told them, or else all policies.

    The policy is an agent or function, a list of them, an object with ``for_preference``, or a function of four
    arguments, which is told the weights last.
    """
    if hasattr(policy, "for_preference"):
        return policy.for_preference  # type: ignore[no-any-return]
    if isinstance(policy, (list, tuple)):
        return list(policy)
    if not hasattr(policy, "act") and callable(policy) and _arguments(policy) == 4:
        return lambda weights: lambda *seen: policy(*seen, weights)
    return [policy]


def _arguments(function: Any) -> int:
    """How many positional arguments a function needs."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of a function without a signature, as some that are compiled
        return 3
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(parameter.kind in positional and parameter.default is parameter.empty for parameter in parameters)


def single(policy: Any) -> Single:
    """The policy of a task with a known utility; a ValueError for a front, or for one that is to be told weights."""
    found = policies_of(policy)
    if not isinstance(found, list) or len(found) != 1:
        raise ValueError("a front, or a policy that is told weights, has no place where the utility is known")
    return found[0]


# ------------------------------------------------------------------------------------------------------------- samples


def utilities(drives: Drives, policy: Any) -> NDArray[np.float64]:
    """(E,) the utility of every episode."""
    return np.asarray(drives.task.make_utility()(returns(drives, policy)))


def returns(drives: Drives, policy: Any) -> NDArray[np.float64]:
    """(E, d) the undiscounted return of every episode."""
    return drives.returns(single(policy))


def returns_by_preference(drives: Drives, policy: Any) -> NDArray[np.float64]:
    """(E, P, d) the undiscounted returns under P preferences, of a policy that is told them, or of a front's best."""
    task, policies = drives.task, policies_of(policy)
    assert task.preferences is not None
    if not isinstance(policies, list):
        return np.stack([drives.returns(policies(weights)) for weights in task.told_weights()], axis=1)
    chosen = np.zeros(task.preferences.count, dtype=np.int64)
    if len(policies) > 1:
        validation = replace(drives, seed=SPLITS["validation"].start, episodes=CHOICE_EPISODES)
        means = np.stack([validation.returns(member).mean(axis=0) for member in policies])
        chosen = (task.hidden_weights() @ means.T).argmax(axis=1)
    driven = {k: drives.returns(policies[k]) for k in np.unique(chosen).tolist()}
    return np.stack([driven[k] for k in chosen.tolist()], axis=1)


def values_under_changes(drives: Drives, policy: Any) -> NDArray[np.float64]:
    """(E, P) what every episode is worth under P preferences that give way to the next one.

    The policy is told them, or is one that is blind to them; a ValueError for a front. One whose ``follows_changes`` is
    False is told the first alone.
    """
    task, policies = drives.task, policies_of(policy)
    assert task.preferences is not None
    if isinstance(policies, list):
        if len(policies) > 1:
            raise ValueError("preferences that change need a policy that is told them, or a single one")
        blind = policies[0]
        policies = lambda _weights: blind  # noqa: E731  # a function of the weights like the others
    told, weights, times = task.told_weights(), task.hidden_weights(), task.preferences.change_times()
    later = np.roll(told, -1, axis=0) if getattr(policy, "follows_changes", True) else told
    pairs = list(zip(told, later, strict=True))
    values = [
        drives.changing(policies(first), policies(second), weights[[p, (p + 1) % len(weights)]], times[p])
        for p, (first, second) in enumerate(pairs)
    ]
    return np.stack(values, axis=1)


def utilities_by_partner(drives: Drives, policy: Any) -> NDArray[np.float64]:
    """(E, S) the utility of every episode with each of S partners."""
    task = drives.task
    assert task.partners is not None
    driver = single(policy)
    met = [drives.returns(driver, partner) for partner in task.partners.names]
    return np.asarray(task.make_utility()(np.stack(met, axis=1)))


# -------------------------------------------------------------------------------------------------------------- scores
# Every score is made of the mean over scenarios of a part (E, k) of the samples. That part is kept (see
# mo_deepdrive.suite.results), and any resample of it is scored by a matrix product.


def scenario_means(_task: Task, samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """(E, 1) the mean of the samples of each scenario."""
    return np.asarray(samples.reshape(len(samples), -1).mean(axis=1, keepdims=True))


def weighted_means(task: Task, samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """(E, 1) what returns (E, P, d) are worth under P preferences, their mean."""
    return scenario_means(task, (samples * task.hidden_weights()).sum(axis=2))


def costs(task: Task, samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """(E, k) the magnitudes of what the rules of a rulebook are about, in their order, and of what counts then."""
    names = task.objectives()
    return -samples[:, [names.index(name) for name in of_rulebook(task)]]


def of_rulebook(task: Task) -> list[str]:
    """The objectives that a task's rulebook is about, in the order of its rules; what counts then is the last."""
    assert task.rulebook is not None
    return [*(rule.objective for rule in task.rulebook.rules), task.rulebook.then]


def mean(_task: Task, means: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean itself."""
    return means[..., 0]


def certainty_equivalent(task: Task, means: NDArray[np.float64]) -> NDArray[np.float64]:
    """The certain value that is worth as much as these episodes."""
    risk = RISK_AVERSE[task.utility.name]  # type: ignore[union-attr]
    return np.asarray(risk.certainty_equivalent(means[..., 0]))


def lexicographic(task: Task, means: NDArray[np.float64]) -> NDArray[np.float64]:
    """Minus the excess of the first rule that is broken, at most 1; else what counts after the rules, from 0 on."""
    assert task.rulebook is not None
    book = task.rulebook
    excess = means[..., :-1] / np.array([rule.at_most for rule in book.rules]) - 1.0
    broken = excess > 0.0
    first = np.take_along_axis(excess, broken.argmax(axis=-1, keepdims=True), axis=-1)[..., 0]
    after = np.maximum(0.0, (book.worst - means[..., -1]) / (book.worst - book.best))
    return np.where(broken.any(axis=-1), -np.minimum(first, 1.0), after)


# ------------------------------------------------------------------------------------------------- further columns
# Each makes, of a task, what makes the number of samples.


def conditional_value_at_risk(task: Task) -> Statistic:
    """The mean value of the worst tenth of the episodes (CVaR10)."""
    risk = RISK_AVERSE[task.utility.name]  # type: ignore[union-attr]

    def worst_tenth(samples: NDArray[np.float64]) -> float:
        values = np.sort(risk.certainty_equivalent(samples))
        return float(values[: max(1, round(TAIL * len(values)))].mean())

    return worst_tenth


def worst_family(task: Task) -> Statistic:
    """The mean utility with the family of partners with whom it is least; a name is that of a family and a number."""
    assert task.partners is not None
    _, families = np.unique([name.rpartition("_")[0] for name in task.partners.names], return_inverse=True)
    members = np.eye(families.max() + 1)[families]
    return lambda samples: float((samples.mean(axis=0) @ members / members.sum(axis=0)).min())


def mean_costs(task: Task, samples: NDArray[np.float64]) -> dict[str, float]:
    """The mean magnitudes per episode of what a rulebook is about."""
    return dict(zip(of_rulebook(task), costs(task, samples).mean(axis=0).tolist(), strict=True))


def controllability(task: Task, samples: NDArray[np.float64]) -> dict[str, float]:
    """Spearman's correlation of weight and mean return over the preferences, of each objective, and their mean.

    It is 0 where the return is always the same, and none of an objective on which all preferences agree.
    """
    weights, achieved = task.hidden_weights(), samples.mean(axis=0)
    found = {
        f"{CONTROLLABILITY}/{name}": float(scipy.stats.spearmanr(w, r).statistic) if np.ptp(r) > 0.0 else 0.0
        for name, w, r in zip(task.objectives(), weights.T, achieved.T, strict=True)
        if np.ptp(w) > 0.0
    }
    return {CONTROLLABILITY: float(np.mean(list(found.values()))), **found}


@dataclass(frozen=True)
class Scorer:
    """How a task is scored: ``score(task, part(task, samples).mean(axis=0))``."""

    collect: Callable[[Drives, Any], NDArray[np.float64]]  #: drives a policy; samples (E, ...), one row per scenario
    part: Callable[
        [Task, NDArray[np.float64]], NDArray[np.float64]
    ]  #: (E, k) of samples, of whose mean the score is made
    score: Callable[[Task, NDArray[np.float64]], NDArray[np.float64]]  #: (...) of means (..., k)
    further: Mapping[str, Callable[[Task], Statistic]] = field(default_factory=dict)  #: numbers by column
    #: Further columns, which have no intervals; None for none.
    details: Callable[[Task, NDArray[np.float64]], dict[str, float]] | None = None

    @property
    def columns(self) -> list[str]:
        """The columns that have intervals; "score" is the one that is normalised."""
        return [SCORE, *self.further]


SCORERS: dict[str, Scorer] = {
    "mean_utility": Scorer(utilities, scenario_means, mean),
    "certainty_equivalent": Scorer(utilities, scenario_means, certainty_equivalent, {CVAR: conditional_value_at_risk}),
    "mean_over_preferences": Scorer(returns_by_preference, weighted_means, mean, details=controllability),
    "mean_over_changing_preferences": Scorer(values_under_changes, scenario_means, mean),
    "rulebook": Scorer(returns, costs, lexicographic, details=mean_costs),
    "mean_over_partners": Scorer(utilities_by_partner, scenario_means, mean, {WORST: worst_family}),
}


@contextmanager
def open_drives(
    task: Task, arguments: Mapping[str, Any], seed: int, episodes: int, *, greedy: bool
) -> Iterator[Drives]:
    """Where a policy is driven, in an environment with ``arguments`` besides the task's own; the rest as of Drives."""
    merged = {**task.environment.arguments, **arguments}
    with closing(make_env(task.environment.id, min(episodes, OUR_ENVS), merged)) as env:
        yield Drives(task, env, seed, episodes, greedy)
