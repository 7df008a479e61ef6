"""How well one network serves preferences that are drawn anew: runs of conditioned MO-PPO for one family of utilities.

    python scripts/conditioned_preferences.py one_waypoint_drawn_front-conditioned_mo_ppo --episodes 100
    python scripts/conditioned_preferences.py RUN RUN --split test --output preferences.csv

Every preference has a greedy policy, and all drive the same episodes. *Own* is the expected utility of a preference, of
the discounted return in scales, under its own policy; *best* is that under the best of all these policies for it. Being
the best of many estimates, it is above *own* by their noise even where every preference has been learnt. Then arrivals,
and the shares of the policies that arrive in 95% or more and in less than 5% of their episodes. The second table has
means over the thirds of the preferences with the lowest and with the highest weight on an objective, or budget for it:
its return, its discounted return, arrivals and the number of decisions. With two vehicles each has tables of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from result_file import check_folder, write_results
from rich.console import Console
from rich.table import Table

from algorithms.conditioned_mo_ppo import ConditionedMOPPO
from algorithms.experiments.build import load_policy
from algorithms.experiments.cli import add_trust_argument, exit_on_error, make_parser
from algorithms.experiments.policy_evaluation import evaluation_env
from algorithms.experiments.run_directory import Run
from mo_deepdrive.evaluation.metrics import vehicle_name
from mo_deepdrive.evaluation.splits import SPLITS, check_episodes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

MOST_PREFERENCES = 10_000
PREFERENCES_SEED = 1  # of the preferences; those of the front have another
ALL, THIRDS = "all", ("lowest", "highest")


@dataclass(frozen=True)
class Served:
    """K preferences of a vehicle and what their policies do.

    Attributes:
        components: names of the m components of a preference, such as ``weight/jerk`` or ``budget/jerk``.
        preferences: (K, m).
        utilities: (K, K) expected utility of each preference (row) under the policy of each (column).
        objectives: names of the d objectives.
        returns: (K, d) mean undiscounted returns.
        discounted: (K, d) mean discounted returns.
        success: (K,) share of the episodes that arrived.
        lengths: (K,) mean number of decisions.
    """

    components: tuple[str, ...]
    preferences: NDArray[np.float64]
    utilities: NDArray[np.float64]
    objectives: tuple[str, ...]
    returns: NDArray[np.float64]
    discounted: NDArray[np.float64]
    success: NDArray[np.float64]
    lengths: NDArray[np.float64]

    @property
    def own(self) -> NDArray[np.float64]:
        """(K,) expected utility of each preference under its own policy."""
        return self.utilities.diagonal()

    @property
    def best(self) -> NDArray[np.float64]:
        """(K,) expected utility of each preference under the best policy for it."""
        return np.asarray(self.utilities.max(axis=1))

    def thirds(self, component: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Masks (K,) of the thirds with the lowest and with the highest number at a component."""
        low, high = np.quantile(self.preferences[:, component], (1 / 3, 2 / 3))
        return self.preferences[:, component] <= low, self.preferences[:, component] >= high


@dataclass(frozen=True)
class Part:
    """Means over some of the preferences of a vehicle, a row of the file.

    Attributes:
        environment: id.
        family: of utilities.
        seed: of the run.
        vehicle: its index.
        component: by which the preferences were chosen; "all" for all of them.
        third: "lowest" or "highest"; "all" for all of them.
        own: expected utility under the own policies.
        best: expected utility under the best policy for each preference.
        undiscounted: return of the objective of the component; NaN for all.
        discounted: its discounted return.
        arrivals: share of the episodes.
        decisions: per episode.
    """

    environment: str
    family: str
    seed: int
    vehicle: int
    component: str
    third: str
    own: Annotated[float, ".4f"]
    best: Annotated[float, ".4f"]
    undiscounted: Annotated[float, ".4g"]
    discounted: Annotated[float, ".4g"]
    arrivals: Annotated[float, ".4f"]
    decisions: Annotated[float, ".1f"]


def serve(run: Run, preferences: int, episodes: int, seed: int) -> list[Served]:
    """Drive ``episodes`` episodes from ``seed`` on under each of ``preferences`` preferences; one result per vehicle.

    Raises:
        ValueError: for a run of another algorithm, or of several families of utilities.
    """
    agent: Any = load_policy(run)
    if not isinstance(agent, ConditionedMOPPO) or len(agent.preferences.used) > 1:
        raise ValueError(f"{str(run.path)!r} must be a run of conditioned_mo_ppo for one family of utilities")
    vehicles, rng = agent.env.vehicles, np.random.default_rng(PREFERENCES_SEED)
    rows = agent.preferences.draw(preferences * vehicles, rng, emphasis=False).reshape(preferences, vehicles, -1)
    env = evaluation_env(run.experiment, episodes)
    try:
        found = agent.evaluate_policies(
            rows.reshape(preferences, -1), env, episodes=episodes, seed=seed, gamma=agent.accrued_discount
        )
    finally:
        env.close()
    served = []
    for v in range(vehicles):
        discounted = torch.from_numpy(np.stack([each.discounted[:, v] for each in found]))  # (K, E, d)
        utilities = [agent.preferences.utility(discounted, torch.from_numpy(row)).mean(dim=1) for row in rows[:, v]]
        served.append(
            Served(
                components=agent.preferences.names,
                preferences=rows[:, v].astype(np.float64),
                utilities=torch.stack(utilities).numpy(),
                objectives=agent.env.objectives,
                returns=np.stack([each.returns[:, v].mean(axis=0) for each in found]),
                discounted=discounted.mean(dim=1).numpy(),
                success=np.array([each.succeeded[:, v].mean() for each in found]),
                lengths=np.array([each.lengths[:, v].mean() for each in found]),
            )
        )
    return served


def parts(served: Served, run: Run, vehicle: int) -> list[Part]:
    """All preferences, then the thirds by each component."""
    experiment, everything = run.experiment, np.ones(len(served.success), dtype=np.bool_)
    chosen: list[tuple[str, str, NDArray[np.bool_]]] = [(ALL, ALL, everything)]
    for component, name in enumerate(served.components):
        chosen += [(name, third, mask) for third, mask in zip(THIRDS, served.thirds(component), strict=True)]
    family = next(name for name, share in experiment.algorithm.config.families.items() if share)
    found = []
    for name, third, mask in chosen:
        i = None if name == ALL else served.objectives.index(name.partition("/")[2])
        returns = [math.nan if i is None else array[mask, i].mean() for array in (served.returns, served.discounted)]
        means = (array[mask].mean() for array in (served.success, served.lengths))
        utilities = (array[mask].mean() for array in (served.own, served.best))
        seed = experiment.training.seed
        found.append(Part(experiment.environment.id, family, seed, vehicle, name, third, *utilities, *returns, *means))
    return found


def tables(served: Served, found: Sequence[Part], title: str) -> tuple[Table, Table]:
    """The whole, and by thirds."""
    everything, *by_component = found
    whole = Table("own", "best", "arrivals", "in 95% or more", "in less than 5%", title=title)
    success = served.success
    shares = (everything.arrivals, (success >= 0.95).mean(), (success < 0.05).mean())
    whole.add_row(f"{everything.own:.3f}", f"{everything.best:.3f}", *(f"{share:.1%}" for share in shares))
    by_third = Table("preference", "third", "return", "discounted", "arrivals", "decisions")
    for part in by_component:
        returns = [f"{value:.4g}" for value in (part.undiscounted, part.discounted)]
        by_third.add_row(part.component, part.third, *returns, f"{part.arrivals:.1%}", f"{part.decisions:.0f}")
    return whole, by_third


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="directory of a run, or a name in the zoo")
    parser.add_argument("--preferences", type=int, default=200, help="number of preferences (default: 200)")
    parser.add_argument("--episodes", type=int, default=50, help="of every policy (default: 50)")
    parser.add_argument("--split", choices=list(SPLITS), default="validation", help="of the scenarios")
    parser.add_argument("--output", type=Path, metavar="FILE", help="also write the numbers of all runs to a CSV file")
    add_trust_argument(parser)
    arguments = parser.parse_args(argv)
    check_folder(parser, arguments.output)
    written: list[Part] = []
    with exit_on_error(ValueError, OSError):
        if not 1 <= arguments.preferences <= MOST_PREFERENCES:
            raise ValueError(f"--preferences {arguments.preferences} must be between 1 and {MOST_PREFERENCES}")
        if arguments.episodes < 1:
            raise ValueError(f"--episodes {arguments.episodes} must be at least 1")
        check_episodes("--episodes", arguments.episodes, arguments.split)
        for name in arguments.runs:
            run = Run.open(name, device="cpu", trust=arguments.trust)
            found = serve(run, arguments.preferences, arguments.episodes, SPLITS[arguments.split].start)
            for v, served in enumerate(found):
                rows = parts(served, run, v)
                for table in tables(served, rows, f"{name}, {vehicle_name(v)}" if len(found) > 1 else name):
                    Console().print(table)
                written += rows
        write_results(arguments.output, written)


if __name__ == "__main__":
    main()
