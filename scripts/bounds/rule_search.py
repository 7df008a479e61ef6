"""The search for the best rule of a family: of one that is blind to what a task tests, or of one that sees it.

Rules are drawn at random, and the better half of them is kept from round to round, among variations of it and over more
episodes of the validation split. The best one is scored on the test split.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np

from algorithms.driving.intersection_rules import MeetingRule, TurningDriver
from algorithms.driving.left_turn_rules import GapDriver, GapRule
from algorithms.driving.named_rules import MAKERS
from algorithms.driving.roundabout_rules import RoundaboutDriver, RoundaboutRule
from algorithms.driving.unskilled import Timed, blind_follower, blind_turner
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import OUR_ENVS, evaluate_each
from mo_deepdrive.evaluation.policy import FunctionPolicy
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.simulation.state import MAX_ACCELERATION, STEER_RANGE
from mo_deepdrive.suite.scorers import SCORERS
from mo_deepdrive.world.actions import action_table
from scripts.bounds.plans import AFTER_DISTANCE, RULE, follow_rule

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.splits import Split
    from mo_deepdrive.suite import Task

    Floats = NDArray[np.float64]
    Function = Callable[..., NDArray[Any]]

ROUNDS = ((1024, 8), (256, 8), (64, 32), (16, 128))  # rules, and episodes of each with each partner
VARIATION = 0.1  # standard deviation of a variation, as a share of the range
DECISION = 0.1  # s


@dataclass(frozen=True)
class Family:
    """Rules that differ in numbers."""

    title: str  #: of one of them
    ranges: Mapping[str, tuple[float, float]]  #: from which each number is drawn, uniformly
    make: Callable[..., Function]  #: of the numbers, each one or (N,), and the action type: the driver of N vehicles
    logarithmic: tuple[str, ...] = ()  #: the numbers whose logarithm is drawn uniformly instead

    def points(self) -> tuple[Floats, Floats]:
        """The lower and the upper ends (F,) of what is drawn uniformly."""
        ends = ([np.log(x) if name in self.logarithmic else x for x in ends] for name, ends in self.ranges.items())
        low, high = np.array(list(ends)).T
        return low, high

    def rules(self, points: Floats) -> Floats:
        """The rules (N, F) of points (N, F)."""
        return np.where([name in self.logarithmic for name in self.ranges], np.exp(points), points)

    def name(self, rule: Floats) -> str:
        """The rule (F,) in words."""
        return f"{self.title}: {', '.join(f'{name} {x:.3g}' for name, x in zip(self.ranges, rule, strict=True))}"

    def policy(self, rules: Floats, action_type: str) -> Function:
        """The driver by rules (N, F) of all vehicles of N episodes, or by one rule (F,) of any number."""

        def drive(observations: NDArray[Any], accrued: NDArray[Any], discounts: NDArray[Any]) -> NDArray[Any]:
            axes, size = observations.shape[:-1], observations.shape[-1]
            if not drivers:
                each = rules.T if rules.ndim == 1 else np.repeat(rules, np.prod(axes[1:], dtype=int), axis=0).T
                drivers.append(self.make(**dict(zip(self.ranges, each, strict=True)), action_type=action_type))
            past = accrued.reshape(-1, accrued.shape[-1]), discounts.reshape(-1)
            actions = drivers[0](observations.reshape(-1, size), *past)
            return actions.reshape(*axes, *actions.shape[1:])

        drivers: list[Function] = []
        return drive


class Objective(NamedTuple):
    """What is maximised, or measured: a number of any resample of the episodes."""

    samples: Callable[[Sequence[Evaluation]], Floats]  #: (E, ...) of evaluations, one with each partner
    number: Callable[[Floats], float]


@dataclass(frozen=True)
class Setting:
    """Where rules drive."""

    env_id: str
    arguments: Mapping[str, Any]
    #: Scripted drivers by name, each of which drives all vehicles but the first; without one a rule drives all.
    partners: tuple[str, ...] = ()

    def drive(self, family: Family, rules: Floats, episodes: int, split: Split) -> list[tuple[Evaluation, ...]]:
        """An evaluation with each partner, or one, of each of the rules (K, F), all in the same scenarios."""
        pairs = len(rules) * max(1, len(self.partners))
        with closing(make_env(self.env_id, min(OUR_ENVS, pairs * episodes), dict(self.arguments))) as env:
            adapter, seed = EnvAdapter(env), SPLITS[split].start

            def policy_of(pairs: NDArray[np.intp]) -> FunctionPolicy:
                return FunctionPolicy(self.driver(family, rules, pairs), adapter, gamma=1.0)

            found = evaluate_each(policy_of, pairs, env, episodes=episodes, seed=seed, gamma=1.0)
        return [tuple(found[k :: len(rules)]) for k in range(len(rules))]

    def driver(self, family: Family, rules: Floats, pairs: NDArray[np.intp]) -> Function:
        """The policy of which episode n is driven by the n-th of the pairs of a partner and a rule."""
        partners, rows = np.divmod(pairs, len(rules))
        action_type = self.arguments.get("action_type", "discrete")
        driver = family.policy(rules[rows], action_type)
        others = [MAKERS[self.env_id](name, action_type) for name in self.partners]

        def drive(observations: NDArray[Any], accrued: NDArray[Any], discounts: NDArray[Any]) -> NDArray[Any]:
            ours = driver(observations[:, :1], accrued[:, :1], discounts[:, :1])
            actions = np.repeat(ours, observations.shape[1], axis=1)
            for partner in np.unique(partners):
                theirs = observations[partners == partner, 1:]
                driven = others[partner](theirs.reshape(-1, theirs.shape[-1]))
                actions[partners == partner, 1:] = driven.reshape(*theirs.shape[:2], *ours.shape[2:])
            return actions

        return drive if others else driver


def setting_of(task: Task) -> Setting:
    """The setting of a task."""
    names = task.partners.names if task.partners is not None else ()
    return Setting(task.environment.id, task.environment.arguments, tuple(names))


def search(
    setting: Setting,
    family: Family,
    objective: Objective,
    rounds: Sequence[tuple[int, int]] = ROUNDS,
    seed: int = 0,
) -> Floats:
    """The numbers (F,) of the rule of the family that is best on the validation split."""
    rng = np.random.default_rng(seed)
    low, high = family.points()
    points = rng.uniform(low, high, (rounds[0][0], len(low)))
    for number, (count, episodes) in enumerate(rounds):
        if number:
            kept = points[: count // 2]
            varied = kept[rng.integers(len(kept), size=count - len(kept))]
            varied = varied + VARIATION * (high - low) * rng.standard_normal(varied.shape)
            points = np.clip(np.concatenate([kept, varied]), low, high)
        driven = setting.drive(family, family.rules(points), episodes, "validation")
        worth = np.array([objective.number(objective.samples(evaluations)) for evaluations in driven])
        points = points[np.argsort(-worth, kind="stable")]
    return np.asarray(family.rules(points[:1])[0])


# ------------------------------------------------------------------------------------------------------------ families

_TURN = {"approach_speed": (1.5, 4.2), "turn_speed": (3.0, 8.0), "exit_speed": (4.0, 10.0)}
_GAP = {"gap": (1.5, 9.0), **_TURN, "stop_distance": (0.2, 2.0), "least_speed": (0.0, 6.0)}
_FOLLOW = {"approach_speed": (2.0, 4.3), "inside_speed": (2.5, 5.5), "exit_speed": (3.0, 8.0)}


def _meeting(*, patience: Floats, action_type: str, **numbers: Any) -> Function:
    return Timed(patience, DECISION, TurningDriver(MeetingRule(**numbers), action_type).drive)


def _blind_turn(*, wait: Floats, action_type: str, meets: bool, **speeds: Any) -> Function:
    return Timed(wait, DECISION, blind_turner(GapRule(gap=0.0, **speeds), action_type, meets=meets))


def _blind_follow(*, wait: Floats, action_type: str, **speeds: Any) -> Function:
    return Timed(wait, DECISION, blind_follower(RoundaboutRule(**speeds), action_type))


# By scenario. A blind family goes after a time, whatever others do.
SEEING = {
    "left_turn": Family(
        "a rule that waits for a gap", _GAP, lambda action_type, **numbers: GapDriver(GapRule(**numbers), action_type)
    ),
    "intersection": Family(
        "a rule that waits for a gap",
        {**_GAP, "commitment": (0.1, 2.0), "patience": (0.0, 40.0)},
        _meeting,
    ),
    "roundabout": Family(
        "a rule that gives way",
        {"gap": (1.5, 6.0), **_FOLLOW, "headway": (0.4, 2.0)},
        lambda action_type, **numbers: RoundaboutDriver(RoundaboutRule(**numbers), action_type),
    ),
}
BLIND = {
    "left_turn": Family("blind to traffic", {"wait": (0.0, 45.0), **_TURN}, partial(_blind_turn, meets=False)),
    "intersection": Family("blind to the other", {"wait": (0.0, 45.0), **_TURN}, partial(_blind_turn, meets=True)),
    "roundabout": Family("blind to others", {"wait": (0.0, 45.0), **_FOLLOW}, _blind_follow),
}
for _families in (SEEING, BLIND):
    _families["roundabout_solo"] = _families["roundabout"]


@numba.njit
def _follow_rules(
    seen: NDArray[Any], rules: NDArray[Any], table: NDArray[Any], actions: NDArray[Any]
) -> None:  # pragma: no cover
    for i in range(len(seen)):
        follow_rule(seen[i], rules[i], 0.0, table, actions[i])


class _Following:
    """Drives to the waypoint by rules of :mod:`scripts.bounds.plans`, with discrete actions and without a clock."""

    def __init__(self, action_type: str, **numbers: Any):
        self._table, self._numbers = action_table(action_type), numbers

    def __call__(self, observations: NDArray[Any], *_: Any, **numbers: Any) -> NDArray[Any]:
        """Actions (N,) for observations (N, o), perhaps with other numbers of the rules."""
        rules = np.zeros(len(observations), dtype=RULE)
        rules["max_steer"], rules["throttle"] = STEER_RANGE, MAX_ACCELERATION
        for name, values in {**self._numbers, **numbers}.items():
            rules[name] = values > 0.5 if name == "hold_speed" else values
        actions = np.zeros((len(observations), 1), dtype=np.int16)
        _follow_rules(observations, rules.view(np.recarray), self._table, actions)
        return actions[:, 0].astype(np.int64)


class _InTime:
    """Drives to the waypoint at a speed by which it arrives within what is left of DEADLINE_SECONDS, if it can.

    The last of the accrued rewards is minus the time.
    """

    def __init__(self, action_type: str, reserve: Floats, least_speed: Floats, most_speed: Floats, **numbers: Any):
        self._following = _Following(action_type, **numbers)
        self._reserve, self._least, self._most = reserve, least_speed, most_speed

    def __call__(self, observations: NDArray[Any], accrued: NDArray[Any], _discounts: NDArray[Any]) -> NDArray[Any]:
        """Actions (N,) for observations (N, o)."""
        left = DEADLINE_SECONDS - self._reserve + accrued[:, -1]
        needed = observations[:, AFTER_DISTANCE] / np.maximum(left, 0.1)
        too_late = (left <= 0.0) | (needed > self._most)
        return self._following(
            observations, target_speed=np.where(too_late, self._least, np.maximum(needed, self._least))
        )


_FOLLOWING = {
    "speed_slack": (0.02, 0.9),
    "hold_speed": (0.0, 1.0),
    "gain": (0.1, 4.0),
    "max_steer": (0.001, 0.3),
    "dead_zone": (0.0, 0.15),
}
FOLLOWING = Family(
    "a rule that drives at the waypoint",
    {"target_speed": (0.5, 10.0), **_FOLLOWING, "brake_distance": (0.0, 8.0)},
    _Following,
    logarithmic=("target_speed", "gain", "max_steer"),
)
DEADLINE_SECONDS = 40.0
DEADLINE = Family(
    "a rule that arrives in time",
    {"reserve": (0.0, 10.0), "least_speed": (0.05, 4.0), "most_speed": (1.0, 12.0), **_FOLLOWING},
    _InTime,
    logarithmic=("least_speed", "gain", "max_steer"),
)

# ----------------------------------------------------------------------------------------------------------- objectives


def objective_of(task: Task, utility: Any = None) -> Objective:
    """The score of a task, or what it were with another utility."""
    scorer, utility = SCORERS[task.score], utility or (task.make_utility() if task.utility else None)

    def samples(met: Any) -> Any:
        returns = np.stack([evaluation.returns[:, task.vehicle] for evaluation in met], axis=1)
        return returns[:, 0] if task.rulebook else utility(returns)

    return Objective(samples, lambda drawn: float(scorer.score(task, scorer.part(task, drawn).mean(axis=0))))
