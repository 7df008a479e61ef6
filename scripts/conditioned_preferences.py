"""How well one network serves preferences that are drawn anew: runs of conditioned MO-PPO for linear utilities.

    python scripts/conditioned_preferences.py one_waypoint_drawn_front-conditioned_mo_ppo --episodes 100

Every preference has a greedy policy, and all drive the same episodes. *Own* is the expected utility of a preference, of
the discounted return in scales, under its own policy; *best* is that under the best of all these policies for it. Being
the best of many estimates, it is above *own* by their noise even where every preference has been learnt. Then arrivals,
and the shares of the policies that arrive in 95% or more and in less than 5% of their episodes. The second table has
means over the thirds of the preferences with the lowest and with the highest weight on an objective: its return, and
arrivals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table

from algorithms.common.preferences import LINEAR
from algorithms.conditioned_mo_ppo import ConditionedMOPPO
from algorithms.evaluation.splits import SPLITS, check_episodes
from algorithms.experiments.build import load_policy
from algorithms.experiments.cli import add_trust_argument, exit_on_error, make_parser
from algorithms.experiments.policy_evaluation import evaluation_env
from algorithms.experiments.run_directory import Run

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

MOST_PREFERENCES = 10_000
PREFERENCES_SEED = 1  # of the preferences; those of the front have another


@dataclass(frozen=True)
class Served:
    """K preferences and what their policies do.

    Attributes:
        objectives: names of the d objectives.
        weights: (K, d) preferences.
        scaled: (K, d) mean discounted returns, in scales.
        returns: (K, d) mean undiscounted returns.
        success: (K,) share of the episodes that arrived.
    """

    objectives: tuple[str, ...]
    weights: NDArray[np.float64]
    scaled: NDArray[np.float64]
    returns: NDArray[np.float64]
    success: NDArray[np.float64]

    @property
    def own(self) -> float:
        """Mean over preferences of the expected utility under the own policy."""
        return float((self.weights * self.scaled).sum(axis=1).mean())

    @property
    def best(self) -> float:
        """Mean over preferences of the expected utility under the best policy for each."""
        return float((self.weights @ self.scaled.T).max(axis=1).mean())

    def thirds(self, objective: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Masks (K,) of the thirds with the lowest and with the highest weight on an objective."""
        low, high = np.quantile(self.weights[:, objective], (1 / 3, 2 / 3))
        return self.weights[:, objective] <= low, self.weights[:, objective] >= high


def serve(run: Run, preferences: int, episodes: int, seed: int) -> Served:
    """Drive ``episodes`` episodes from ``seed`` on under each of ``preferences`` preferences.

    Raises:
        ValueError: for a run of another algorithm, of several vehicles, or of other families of utilities.
    """
    agent: Any = load_policy(run)
    if not isinstance(agent, ConditionedMOPPO) or agent.env.vehicles > 1 or agent.preferences.used != [LINEAR]:
        raise ValueError(f"{str(run.path)!r} must be a run of conditioned_mo_ppo, of one vehicle and linear utilities")
    conditions = agent.preferences.draw(preferences, np.random.default_rng(PREFERENCES_SEED), emphasis=False)
    env = evaluation_env(run.experiment, episodes)
    try:
        found = agent.evaluate_policies(conditions, env, episodes=episodes, seed=seed, gamma=agent.accrued_discount)
    finally:
        env.close()
    return Served(
        objectives=agent.env.objectives,
        weights=conditions.astype(np.float64),
        scaled=np.stack([each.discounted[:, 0].mean(axis=0) for each in found]) / agent.scales,
        returns=np.stack([each.returns[:, 0].mean(axis=0) for each in found]),
        success=np.array([each.succeeded[:, 0].mean() for each in found]),
    )


def tables(served: Served, title: str) -> tuple[Table, Table]:
    """The whole, and by thirds."""
    whole = Table("own", "best", "arrivals", "in 95% or more", "in less than 5%", title=title)
    success = served.success
    shares = (success.mean(), (success >= 0.95).mean(), (success < 0.05).mean())
    whole.add_row(f"{served.own:.3f}", f"{served.best:.3f}", *(f"{share:.1%}" for share in shares))
    by_weight = Table("weight on", "low: return", "high: return", "low: arrivals", "high: arrivals")
    for i, name in enumerate(served.objectives):
        parts = served.thirds(i)
        cells = [f"{served.returns[part, i].mean():.4g}" for part in parts]
        by_weight.add_row(name, *cells, *(f"{success[part].mean():.1%}" for part in parts))
    return whole, by_weight


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="directory of a run, or a name in the zoo")
    parser.add_argument("--preferences", type=int, default=200, help="number of preferences (default: 200)")
    parser.add_argument("--episodes", type=int, default=50, help="of every policy (default: 50)")
    parser.add_argument("--split", choices=list(SPLITS), default="validation", help="of the scenarios")
    add_trust_argument(parser)
    arguments = parser.parse_args(argv)
    with exit_on_error(ValueError, OSError):
        if not 1 <= arguments.preferences <= MOST_PREFERENCES:
            raise ValueError(f"--preferences {arguments.preferences} must be between 1 and {MOST_PREFERENCES}")
        if arguments.episodes < 1:
            raise ValueError(f"--episodes {arguments.episodes} must be at least 1")
        check_episodes("--episodes", arguments.episodes, arguments.split)
        for name in arguments.runs:
            run = Run.open(name, device="cpu", trust=arguments.trust)
            found = serve(run, arguments.preferences, arguments.episodes, SPLITS[arguments.split].start)
            for table in tables(found, name):
                Console().print(table)


if __name__ == "__main__":
    main()
