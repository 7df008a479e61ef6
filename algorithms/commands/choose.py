"""Choose a policy of a front by a preference, and show its returns in new episodes.

    mo-deepdrive choose RUN --weights distance=1 jerk=0.01
    mo-deepdrive choose RUN --utility one_waypoint_nonlinear --video drive.mp4
    mo-deepdrive choose RUN --target distance=14 g_force=-6
    mo-deepdrive choose RUN --weights distance=1 jerk=0.01 --policy 12 --split test
    mo-deepdrive choose RUN --ask

RUN is a finished run of an algorithm that learns a front, or the name of one in the zoo. All of its policies are
evaluated again. --weights chooses the greatest weighted sum of returns (objectives that are not named have weight 0),
--utility the greatest expected utility, --target the policy whose mean returns fall short of the named returns by the
smallest distance, in nominal scales of the objectives. --ask shows the mean returns of two policies at a time, asks
which of them is preferred, and finds weights that explain the answers. What is chosen looks better than it is in the
episodes by which it was chosen: --policy scores one policy in others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.runs import cli
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.statistics import MIN_SAMPLES, Estimate, mean, rate, resample
from mo_deepdrive.support.yaml import read_value
from mo_deepdrive.utilities import check_utility, make_utility
from mo_deepdrive.world.config import UtilityChoice, parse

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray
    from rich.table import Table

    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.front import Front
    from mo_deepdrive.utilities import Utility

RUNNERS_UP = 4


@dataclass(frozen=True)
class ChoiceCriterion:
    """What to maximise over the policies of a front."""

    name: str  #: of the value, for tables
    #: From returns (K, E, d) of E episodes of each of K policies to the values (K,) of the policies.
    values: Callable[[NDArray[np.float64]], NDArray[np.float64]]

    def estimate(self, returns: NDArray[np.float64]) -> Estimate:
        """The value of one policy from returns (E, d) of its episodes, with its bootstrap interval."""
        return resample(returns, lambda part: float(self.values(part[None])[0]))


def weighted_sum(weights: Mapping[str, float], objectives: Sequence[str]) -> ChoiceCriterion:
    """Prefer the greatest sum of mean returns, weighted by objective (0 where it is not named).

    A ValueError if a weight is negative; ``objectives`` are the d names in the order of the returns.
    """
    if any(weight < 0.0 for weight in weights.values()):
        raise ValueError(f"weights {dict(weights)}: returns are maximised, so weights must not be negative")
    w = np.array([weights.get(name, 0.0) for name in objectives])
    return ChoiceCriterion("weighted sum", lambda returns: (returns @ w).mean(axis=1))


def expected_utility(utility: Utility) -> ChoiceCriterion:
    """Prefer the greatest expected utility of the returns (the ESR criterion): the mean of the episodes' utilities."""
    return ChoiceCriterion(f"expected {utility.name}", lambda returns: np.asarray(utility(returns)).mean(axis=1))


def distance_to_target(target: Mapping[str, float], objectives: Sequence[str], scales: NDArray[Any]) -> ChoiceCriterion:
    """Prefer the smallest Euclidean distance, in ``scales`` (d,), by which the mean returns fall short of a target.

    Objectives that it does not name, and returns above it, do not count.
    """
    wanted = np.array([target.get(name, -np.inf) for name in objectives])

    def closeness(returns: NDArray[np.float64]) -> NDArray[np.float64]:
        shortfall = np.maximum(wanted - returns.mean(axis=1), 0.0) / scales
        return -np.asarray(np.linalg.norm(shortfall, axis=1))

    return ChoiceCriterion("minus the distance to the target", closeness)


def ask(means: NDArray[np.float64], objectives: Sequence[str], scales: NDArray[Any]) -> ChoiceCriterion:
    """Ask for preferences between policies by their mean returns (K, d), and prefer the expected weights.

    The end of the input ends the questions; a ValueError if there has been no answer.
    """
    from mo_deepdrive.evaluation.elicitation import QUESTIONS, Elicitation

    elicitation, answers = Elicitation(means / scales), list[tuple[int, int]]()
    width = max(map(len, objectives))
    while len(answers) < QUESTIONS and (pair := elicitation.next_pair(answers)):
        print(f"\nquestion {len(answers) + 1} of {QUESTIONS}{'1':>{width - 1}}{'2':>12}")
        for name, *values in zip(objectives, *means[list(pair)], strict=True):
            print(f"  {name:<{width}}" + "".join(f"{value:>12.4g}" for value in values))
        try:
            answer = input("which one do you prefer, 1 or 2? ").strip()
        except EOFError:
            break
        if answer in ("1", "2"):
            answers.append(pair if answer == "1" else pair[::-1])
    if not answers:
        raise ValueError("--ask: no question was answered; each answer is 1 or 2")
    weights, low, high = elicitation.estimate(answers)
    print("\nweights of returns in nominal scales, with 90% intervals:")
    for name, *values in zip(objectives, weights, low, high, strict=True):
        print(f"  {name:<{width}}  {values[0]:.2f}  [{values[1]:.2f}, {values[2]:.2f}]")
    return ChoiceCriterion("utility of the answers", lambda returns: ((returns / scales) @ weights).mean(axis=1))


def rank_policies(
    values: NDArray[np.float64], mean_returns: NDArray[np.float64], scales: NDArray[Any]
) -> NDArray[np.intp]:
    """Indices (K,) of policies in the order of their ``values`` (K,), the greatest first.

    Values that differ only by rounding errors are equal: then the greater sum of ``mean_returns`` (K, d), divided by
    ``scales`` (d,), comes first. A value that is not finite is a ValueError.
    """
    if not np.isfinite(values).all():
        (first, *_) = np.flatnonzero(~np.isfinite(values)).tolist()
        raise ValueError(f"policy {first} is worth {values[first]}; every policy must be worth a finite number")
    largest = float(np.abs(values).max())
    rounded = np.round(values / largest, 9) if largest > 0.0 else values
    return np.lexsort((-(mean_returns / scales).sum(axis=1), -rounded))


def parse_criterion(options: cli.Options, objectives: tuple[str, ...], scales: NDArray[Any]) -> ChoiceCriterion:
    """What to choose by, from the command line."""
    if options.arguments != "{}" and options.utility is None:
        raise ValueError("--arguments can only be given with --utility")
    if options.utility is not None:
        arguments = read_value(options.arguments)
        if not isinstance(arguments, dict):
            raise ValueError(f"--arguments {options.arguments!r} must be a mapping")
        choice = parse(UtilityChoice, {"name": options.utility, "arguments": arguments}, "--arguments")
        utility = make_utility(choice.name, objectives, **choice.arguments)
        check_utility(utility, np.zeros)
        return expected_utility(utility)
    if options.weights is not None:
        return weighted_sum(cli.named_numbers("--weights", options.weights, objectives), objectives)
    return distance_to_target(cli.named_numbers("--target", options.target, objectives), objectives, scales)


def choice_table(
    front: Front,
    evaluations: list[Evaluation],
    criterion: ChoiceCriterion,
    values: NDArray[Any],
    names: dict[int, str],
) -> Table:
    """The best policy with intervals, and the next best; ``values`` are what the criterion gives the policies."""
    from algorithms.reporting.fronts import episodes_note
    from algorithms.reporting.tables import make_table

    episodes = len(evaluations[0].returns)
    title = f"{len(front)} polic{'y' if len(front) == 1 else 'ies'} by {criterion.name}; {episodes_note(episodes)}"
    shown = [evaluations[k] for k in names]
    # The value by which a policy was chosen is too high, whatever its interval.
    worth = [criterion.estimate(shown[0].joint_returns)] if len(front) == 1 else [Estimate(values[k]) for k in names]
    estimates = {criterion.name: worth}
    for i, objective in enumerate(front.objectives):
        estimates[objective] = [mean(evaluation.joint_returns[:, i]) for evaluation in shown]
    if np.isfinite(front.success).all():
        arrivals = [rate(evaluation.joint_succeeded) for evaluation in shown]
        estimates["arrivals"] = arrivals if episodes >= MIN_SAMPLES else [Estimate(share.value) for share in arrivals]
    estimates["decisions"] = [mean(evaluation.joint_lengths.astype(np.float64)) for evaluation in shown]
    rows = [["", *names.values()]]
    for name, (first, *rest) in estimates.items():
        rows.append([name, first.text(), *(f"{estimate.value:.4g}" for estimate in rest)])
    return make_table(rows, 1, unbroken=range(1, len(rows[0])), title=title)


def choose(options: cli.Options) -> int:
    """Evaluate the policies of a front, choose one, show it and film it if asked to."""
    from algorithms.runs.build import load_policy
    from algorithms.runs.console import make_console
    from algorithms.runs.report import evaluate_front_policies, film_policies_of_front
    from mo_deepdrive.evaluation.front import Front

    console = make_console()
    run = Run.open(options.run, trust=options.trust)
    experiment = run.experiment
    cli.check_front(run, options.run)
    episodes, seed = cli.evaluation_arguments(options, experiment)
    every = Front.read(run.path)
    numbers = [*range(len(every))] if options.policy is None else [cli.policy_index(options.policy, len(every))]
    front = every.take(numbers)
    agent = load_policy(run)
    if options.ask and len(front) == 1:
        raise ValueError("--ask compares policies; there is one")
    criterion = None if options.ask else parse_criterion(options, front.objectives, agent.front_scales)
    evaluations = evaluate_front_policies(agent, front, experiment, episodes=episodes, seed=seed)
    returns = np.stack([evaluation.joint_returns for evaluation in evaluations])
    criterion = criterion or ask(returns.mean(axis=1), front.objectives, agent.front_scales)
    with np.errstate(all="ignore"):  # what is not finite is refused below
        values = criterion.values(returns)
    order = rank_policies(values, returns.mean(axis=1), agent.front_scales).tolist()
    best = numbers[order[0]]
    names = {k: f"policy {numbers[k]}" for k in order[: RUNNERS_UP + 1]}
    names[order[0]] += ": chosen" if options.policy is None else ""
    console.print(choice_table(front, evaluations, criterion, values, names))
    console.print(f"policy {best} of {run.path / 'front.csv'}")
    filmed = not options.video or film_policies_of_front(
        agent, every, experiment, options.video, console, seed=seed, policies=[best]
    )
    return 0 if filmed else cli.FAILED


OPTIONS = (
    cli.RUN,
    cli.one_of(
        cli.many("--weights", "OBJECTIVE=W", "the weight of each undiscounted return"),
        cli.option("--utility", "NAME", "a utility by name, or package.module:function"),
        cli.many("--target", "OBJECTIVE=R", "undiscounted returns to be reached"),
        cli.flag("--ask", "answer questions of the form: which of these two do you prefer?"),
        required=True,
    ),
    cli.option("--arguments", "YAML", "arguments of the utility, such as '{weights: [1, 2]}'", default="{}"),
    cli.option("--policy", "K", "score this policy of front.csv instead of choosing one", type=int),
    *cli.evaluation_options(cli.CHOICE_EPISODES, cli.CHOICE_SPLIT),
    cli.option("--video", "FILE", "also film the chosen policy"),
    cli.TRUST,
)
main = cli.Command("choose", __doc__, OPTIONS, choose)
