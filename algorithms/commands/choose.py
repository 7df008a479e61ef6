"""Choose a policy of a front by a preference, and show its returns in new episodes.

    mo-deepdrive choose RUN --weights distance=1 jerk=0.01
    mo-deepdrive choose RUN --utility one_waypoint_nonlinear --video drive.mp4
    mo-deepdrive choose RUN --target distance=14 g_force=-6
    mo-deepdrive choose RUN --weights distance=1 jerk=0.01 --policy 12 --split test

RUN is a finished run of an algorithm that learns a front, or the name of one in the zoo. All of its policies are
evaluated again. --weights chooses the greatest weighted sum of returns (objectives that are not named have weight 0),
--utility the greatest expected utility, --target the policy whose mean returns fall short of the named returns by the
smallest distance, in nominal scales of the objectives. What is chosen looks better than it is in the episodes by which
it was chosen: --policy scores one policy in others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.runs.cli import (
    CHOICE_EPISODES,
    CHOICE_SPLIT,
    FAILED,
    TRUST,
    Command,
    OneOf,
    check_front,
    evaluation_arguments,
    evaluation_options,
    many,
    named_numbers,
    option,
    policy_index,
    video_option,
)
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.choice import (
    ChoiceCriterion,
    distance_to_target,
    expected_utility,
    rank_policies,
    weighted_sum,
)
from mo_deepdrive.support.yaml import read_value
from mo_deepdrive.utilities import check_utility, make_utility
from mo_deepdrive.world.config import UtilityChoice, parse

if TYPE_CHECKING:
    from argparse import Namespace

    from numpy.typing import NDArray
    from rich.table import Table

    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.front import Front

RUNNERS_UP = 4


def parse_criterion(options: Namespace, objectives: tuple[str, ...], scales: NDArray[Any]) -> ChoiceCriterion:
    """What to choose by, from the command line.

    Raises:
        ValueError: for unknown objectives or utilities, or numbers that are not valid.
    """
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
        return weighted_sum(named_numbers("--weights", options.weights, objectives), objectives)
    return distance_to_target(named_numbers("--target", options.target, objectives), objectives, scales)


def choice_table(
    front: Front,
    evaluations: list[Evaluation],
    criterion: ChoiceCriterion,
    values: NDArray[Any],
    order: list[int],
    numbers: list[int],
    *,
    was_chosen: bool,
) -> Table:
    """The best policy with intervals, and the next best policies next to it.

    Args:
        front: K policies.
        evaluations: of each of them.
        criterion: by which they were ordered.
        values: (K,) what each is worth.
        order: their positions, the best one first.
        numbers: of the K policies in front.csv.
        was_chosen: whether the best one was chosen by these episodes; if not, its value has an interval.
    """
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from mo_deepdrive.evaluation.statistics import MIN_SAMPLES, Estimate, mean, of_three, rate

    chosen, *others = order[: RUNNERS_UP + 1]
    episodes = len(evaluations[0].returns)
    intervals = episodes >= MIN_SAMPLES
    how = f"{episodes} episode{'' if episodes == 1 else 's'} each" + (
        f", 95% intervals{of_three([episodes], 'episodes')}" if intervals else ""
    )
    table = Table(
        title=f"{len(front)} polic{'y' if len(front) == 1 else 'ies'} by {criterion.name}; {how}",
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
    )
    table.add_column("", overflow="fold")
    table.add_column(f"policy {numbers[chosen]}{': chosen' if was_chosen else ''}", justify="right", no_wrap=True)
    for k in others:
        table.add_column(f"policy {numbers[k]}", justify="right", no_wrap=True)
    shown = [evaluations[k] for k in (chosen, *others)]
    # The value by which a policy was chosen is too high, whatever its interval.
    worth = (
        [Estimate(float(values[k])) for k in (chosen, *others)]
        if was_chosen
        else [criterion.estimate(shown[0].joint_returns)]
    )
    rows = [(criterion.name, worth)]
    for i, objective in enumerate(front.objectives):
        rows.append((objective, [mean(each.joint_returns[:, i]) for each in shown]))
    if np.isfinite(front.success).all():
        arrivals = [rate(each.joint_succeeded) for each in shown]
        rows.append(("arrivals", arrivals if intervals else [Estimate(each.value) for each in arrivals]))
    rows.append(("decisions", [mean(each.joint_lengths.astype(np.float64)) for each in shown]))
    for name, (first, *rest) in rows:
        table.add_row(name, first.text().replace("[", r"\["), *(f"{each.value:.4g}" for each in rest))
    return table


def choose(options: Namespace) -> int:
    """Evaluate the policies of a front, choose one, show it and film it if asked to."""
    from algorithms.runs.agent_report import film_policies_of_front
    from algorithms.runs.build import load_policy
    from algorithms.runs.console import make_console
    from algorithms.runs.policy_evaluation import evaluate_front_policies
    from mo_deepdrive.evaluation.front import Front

    console = make_console()
    run = Run.open(options.run, trust=options.trust)
    experiment = run.experiment
    check_front(run)
    episodes, seed = evaluation_arguments(options, experiment)
    front = every = Front.read(run.path)
    numbers = list(range(len(every)))
    if options.policy is not None:
        numbers = [policy_index(options.policy, len(every))]
        front = front.take(numbers)
    agent = load_policy(run)
    criterion = parse_criterion(options, front.objectives, agent.front_scales)
    evaluations = evaluate_front_policies(agent, front, experiment, episodes=episodes, seed=seed)
    returns = np.stack([each.joint_returns for each in evaluations])
    with np.errstate(all="ignore"):  # what is not finite is refused below
        values = criterion.values(returns)
    order = rank_policies(values, returns.mean(axis=1), agent.front_scales).tolist()
    was_chosen, best = options.policy is None, numbers[order[0]]
    console.print(choice_table(front, evaluations, criterion, values, order, numbers, was_chosen=was_chosen))
    console.print(f"policy {best} of {run.path / 'front.csv'}")
    filmed = not options.video or film_policies_of_front(
        agent, every, experiment, options.video, console, seed=seed, policies=[best]
    )
    return 0 if filmed else FAILED


OPTIONS = (
    option("run", "RUN", "directory of a finished run, or a name in the zoo"),
    OneOf(
        (
            many("--weights", "OBJECTIVE=W", "the weight of each undiscounted return"),
            option("--utility", "NAME", "a utility by name, or package.module:function"),
            many("--target", "OBJECTIVE=R", "undiscounted returns to be reached"),
        ),
        required=True,
    ),
    option("--arguments", "YAML", "arguments of the utility, such as '{weights: [1, 2]}'", default="{}"),
    option("--policy", "K", "score this policy of front.csv instead of choosing one", type=int),
    *evaluation_options(CHOICE_EPISODES, CHOICE_SPLIT),
    video_option("also film the chosen policy"),
    TRUST,
)
main = Command("choose", __doc__, OPTIONS, choose)
