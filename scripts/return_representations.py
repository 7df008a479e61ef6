"""What a critic of the distribution of returns can represent: expected utilities on a grid and by particles.

    python scripts/return_representations.py --output return_representations.csv

Policies of OneWaypoint drive episodes of the validation split. MOCAC's two critics (:mod:`algorithms.mocac`) are
fitted to their undiscounted returns, without a state and without bootstrapping, and the expected utility of the fit is
compared with that of the returns. The largest grid that MOCAC allows for four objectives has 8 atoms of each; it lies
between plus and minus the nominal scales, its default, or spans the returns of all these policies, which a training
would have to know. docs/learning.md has the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from result_file import check_folder, write_results
from rich.console import Console
from rich.table import Table

from algorithms import zoo
from algorithms.common.return_distributions import CategoricalGrid, Particles, ReturnDistribution, project
from algorithms.experiments.build import load_policy
from algorithms.experiments.cli import exit_on_error, make_parser
from algorithms.experiments.run_directory import Run
from algorithms.mocac import WIDE
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.splits import check_episodes
from mo_deepdrive.utilities import make_utility

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

ENV_ID = "mo-deepdrive-one-waypoint-v0"
RANDOM = "random actions"
POLICIES = (RANDOM, "one_waypoint_linear-ppo", "one_waypoint_nonlinear-mo_ppo")
UTILITIES = ("one_waypoint_nonlinear", "one_waypoint_comfort_budget")
ATOMS, PARTICLES = 8, 32
GRADIENT_STEPS, BATCH, LEARNING_RATE = 3000, 256, 0.03


@dataclass(frozen=True)
class Result:
    """One critic for the returns of one policy.

    Attributes:
        policy: whose returns they are.
        utility: that is expected.
        critic: that was fitted to the returns.
        of_returns: expected utility of the returns.
        of_critic: expected utility of the fit.
    """

    policy: str
    utility: str
    critic: str
    of_returns: Annotated[float, ".4f"]
    of_critic: Annotated[float, ".4f"]


def drive(name: str, env: Any, episodes: int) -> NDArray[np.float64]:
    """(E, d) undiscounted returns of a policy that samples its actions."""
    adapter, rng = EnvAdapter(env), np.random.default_rng(0)

    def act_at_random(observations: NDArray[np.float32], *_: Any) -> NDArray[np.int64]:
        return rng.integers(adapter.actions, size=len(observations))

    policy: Any = act_at_random if name == RANDOM else load_policy(Run.open(zoo.find(name)))
    return evaluate(policy, env, episodes=episodes, greedy=name == RANDOM).returns[:, 0]


def fit_grid(grid: CategoricalGrid, returns: torch.Tensor) -> torch.Tensor:
    """Logits (1, outputs) of the mean of the projected returns, by which the cross entropy of eq. 7 is least."""
    rows = len(returns)
    nothing = torch.full((rows, grid.outputs), 1.0 / grid.outputs)
    masses = project(nothing, returns, torch.zeros(rows), grid.values).mean(dim=0, keepdim=True)
    return masses.log()


def fit_particles(particles: Particles, returns: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Outputs (1, outputs) by gradient descent on the energy distance of eq. 8, from particles at random returns."""
    first = returns[torch.randint(len(returns), (particles.number,), generator=generator)] / particles.scales
    outputs = first.reshape(1, -1).clone().requires_grad_()
    optimiser = torch.optim.Adam([outputs], lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.01, GRADIENT_STEPS)
    for _ in range(GRADIENT_STEPS):
        batch = returns[torch.randint(len(returns), (BATCH,), generator=generator)]
        rows = outputs.detach().expand(BATCH, -1)
        loss = particles.loss(rows, batch, torch.zeros(BATCH), rows, torch.full((BATCH,), 1.0 / BATCH))
        [(_, gradient)] = loss.gradients
        outputs.grad = torch.from_numpy(gradient).reshape(BATCH, -1).sum(dim=0, keepdim=True)
        optimiser.step()
        schedule.step()
    return outputs.detach()


def critics(all_returns: torch.Tensor, scales: torch.Tensor) -> dict[str, ReturnDistribution]:
    """By name."""
    ends = (all_returns.min(dim=0).values.tolist(), all_returns.max(dim=0).values.tolist())
    near, wide = scales.tolist(), (WIDE * scales).tolist()
    device = scales.device
    return {
        f"grid of {ATOMS} atoms": CategoricalGrid([-each for each in near], near, ATOMS, device),
        f"grid of {ATOMS} atoms over the returns": CategoricalGrid(*ends, ATOMS, device),
        f"{PARTICLES} particles": Particles(PARTICLES, scales, [-each for each in wide], wide),
    }


def compare(episodes: int) -> list[Result]:
    """Every critic for every policy under every utility."""
    env = make_env(ENV_ID, min(episodes, 256))
    adapter = EnvAdapter(env)
    scales = torch.from_numpy(adapter.objective_scales)
    returns = {name: torch.from_numpy(drive(name, env, episodes)).float() for name in POLICIES}
    results = []
    for name, (critic, distribution) in product(POLICIES, critics(torch.cat([*returns.values()]), scales).items()):
        own, generator = returns[name], torch.Generator().manual_seed(0)
        outputs = (
            fit_grid(distribution, own)
            if isinstance(distribution, CategoricalGrid)
            else fit_particles(distribution, own, generator)  # type: ignore[arg-type]
        )
        for utility in UTILITIES:
            u = make_utility(utility, adapter.objectives)
            past, one = torch.zeros(1, len(scales)), torch.ones(1)
            expected = float(distribution.expected_utility(u, outputs, past, one)[0])
            results.append(Result(name, utility, critic, float(u(own).mean()), expected))
    return results


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--episodes", type=int, default=1000, help="of every policy (default: %(default)s)")
    parser.add_argument("--output", type=Path, metavar="FILE", help="also write the numbers to a CSV file")
    arguments = parser.parse_args(argv)
    check_folder(parser, arguments.output)
    with exit_on_error(ValueError, OSError):
        if arguments.episodes < 1:
            raise ValueError(f"--episodes {arguments.episodes} must be at least 1")
        check_episodes("--episodes", arguments.episodes, "validation")
        results = compare(arguments.episodes)
        write_results(arguments.output, results)
    table = Table("policy", "utility", "critic", "of the returns", "of the critic")
    for each in results:
        table.add_row(each.policy, each.utility, each.critic, f"{each.of_returns:.2f}", f"{each.of_critic:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
