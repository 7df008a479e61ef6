"""MOMAland's learners at the intersection, with their own settings, scored on the test split.

    python scripts/momaland_learners.py momappo gpi_ls --output momaland_learners.csv

momappo is MOMAland's multi-agent PPO, with one actor for both vehicles and a critic of the state. gpi_ls is
morl-baselines' GPI-LS with continuous actions on both vehicles at once, which MOMAland's CentraliseAgent joins. Both
learn on the parallel environment, in which a vehicle that has ended waits for the other one. The extra
``[integrations]`` brings the libraries.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import torch
from rich.console import Console

import mo_deepdrive
from algorithms.experiments.cli import check_file, make_parser
from algorithms.peers.running import seed_everything
from mo_deepdrive.atomic_io import atomic_write, csv_bytes
from mo_deepdrive.evaluation import evaluate
from mo_deepdrive.evaluation.metrics import vehicle_name
from mo_deepdrive.extras import needed_for
from mo_deepdrive.objectives import scales
from mo_deepdrive.utilities import make_utility

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from numpy.typing import NDArray

    Act = Callable[[NDArray[np.float32], bool], NDArray[Any]]  # observations (N, 2, o), greedy

ENV_ID, UTILITY = "mo-deepdrive-intersection-v0", "intersection_linear"


def make_parallel(**options: Any) -> Any:
    """The parallel environment with an observation of every agent in every step, which MOMAland's wrappers look up."""
    return mo_deepdrive.parallel_env(keep_finished=True, **options)


def check_libraries() -> None:
    """Refuse to start where a library is missing.

    Raises:
        ImportError: naming it and the extra that brings it.
    """
    for library in ("momaland", "morl_baselines", "jax", "distrax", "supersuit"):
        with needed_for("scripts/momaland_learners.py", extra="integrations"):
            importlib.import_module(library)


def indicators() -> NDArray[np.float32]:
    """What SuperSuit's wrapper, which MOMAland's MAPPO uses, appends to the observation of each vehicle: (V, V)."""
    from supersuit import agent_indicator_v0

    plain, marked = make_parallel(), agent_indicator_v0(make_parallel())
    observations, _ = marked.reset(seed=0)
    sizes = {agent: plain.observation_space(agent).shape[0] for agent in plain.possible_agents}
    marks: NDArray[np.float32] = np.stack([observations[agent][size:] for agent, size in sizes.items()])
    return marks


def momappo(seed: int, decisions: int) -> Act:
    """Train MOMAland's MAPPO for the utility, with the defaults of its command line."""
    import jax
    from momaland.learning.cooperative_momappo import discrete_momappo as library

    env = make_parallel()
    command = ["momappo", "--env-id", "driving", "--ref-point", "0", f"--seed={seed}"]
    with patch.object(sys, "argv", [*command, f"--timesteps-per-weight={decisions}"]):
        settings = library.parse_args()
    actor = library.Actor(env.action_space("vehicle_0").n, settings.actor_net_arch, settings.activation)
    critic = library.Critic(settings.critic_net_arch, settings.activation)
    # The library's functions read these as globals, which its command line sets.
    shared = {"args": settings, "env": env, "actor": actor, "critic": critic, "current_timestep": 0}
    vars(library).update(shared, vmapped_get_value=jax.vmap(critic.apply, in_axes=(None, 0)))
    critic.apply = jax.jit(critic.apply)
    # It divides every component by a running estimate of its deviation; nominal sizes undo that roughly.
    weights = np.asarray(make_utility(UTILITY, env.objectives).weights) * scales(env.objectives)
    result = library.train(settings, env, weights / weights.sum(), jax.random.PRNGKey(seed))
    parameters = result["runner_state"][0].params
    logits_of = jax.jit(lambda inputs: actor.apply(parameters, inputs).logits)
    generator = np.random.default_rng(seed)
    marks = indicators()

    def act(observations: NDArray[np.float32], greedy: bool) -> NDArray[Any]:
        marked = np.concatenate([observations, np.broadcast_to(marks, (len(observations), *marks.shape))], axis=-1)
        logits = np.asarray(logits_of(marked))
        scores = logits if greedy else logits + generator.gumbel(size=logits.shape)
        return np.asarray(scores.argmax(-1))

    return act


def gpi_ls(seed: int, decisions: int) -> Act:
    """Train a central GPI-LS with the settings of MOMAland's script for continuous actions."""
    from momaland.utils.parallel_wrappers import CentraliseAgent
    from morl_baselines.multi_policy.gpi_pd.gpi_pd_continuous_action import GPILSContinuousAction

    env, evaluation_env = (CentraliseAgent(make_parallel(action_type="continuous")) for _ in range(2))
    settings = {"learning_rate": 3e-4, "gradient_updates": 3, "policy_noise": 0.05, "use_gpi": True}
    agent = GPILSContinuousAction(env, log=False, seed=seed, device="cpu", **settings)
    agent.train(
        decisions,
        evaluation_env,
        np.full(len(env.unwrapped.objectives), -1000.0),
        num_eval_episodes_for_front=1,  # of up to 600 decisions each, which count as training time
        timesteps_per_iter=decisions // 4,  # four weight vectors
        checkpoints=False,
    )
    weights = np.asarray(make_utility(UTILITY, env.unwrapped.objectives).weights)
    preference = torch.as_tensor(weights / weights.sum(), dtype=torch.float32)

    @torch.no_grad()
    def act(observations: NDArray[np.float32], greedy: bool) -> NDArray[Any]:
        del greedy  # its policy is deterministic
        joined = torch.as_tensor(observations).flatten(1)
        actions = agent.policy(joined, preference.expand(len(joined), -1)).reshape(len(joined), 2, -1)
        return np.asarray(actions)

    return act


LEARNERS: dict[str, tuple[Callable[[int, int], Act], str, tuple[bool, ...]]] = {
    "momappo": (momappo, "discrete", (False, True)),
    "gpi_ls": (gpi_ls, "continuous", (True,)),
}
DECISIONS = {"momappo": 71_680, "gpi_ls": 2_800}  # about 140 s of CPU time each
LEAST_DECISIONS = 128  # of one update of momappo


def score(act: Act, action_type: str, greedy: bool, episodes: int) -> dict[str, float]:
    """Shares of arrivals and collisions, and mean utilities, on the test split."""
    evaluation = evaluate(
        lambda observations, *_: act(observations, greedy),
        ENV_ID,
        split="test",
        episodes=episodes,
        utility=UTILITY,
        env_kwargs={"action_type": action_type},
    )
    collided = evaluation.ends == "collision"
    scores = {"both_arrive": evaluation.succeeded.all(axis=1).mean(), "collisions": collided.any(axis=1).mean()}
    for v in range(2):
        scores[f"{vehicle_name(v)}_arrives"] = evaluation.succeeded[:, v].mean()
        scores[f"{vehicle_name(v)}_collides"] = collided[:, v].mean()
        scores[f"{vehicle_name(v)}_utility"] = evaluation.episode_utilities(v).mean()
    return {name: round(float(value), 4) for name, value in scores.items()}


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """The options of this script."""
    parser = make_parser(__doc__)
    parser.add_argument("learners", nargs="+", choices=LEARNERS, metavar="LEARNER", help=" or ".join(LEARNERS))
    parser.add_argument("--output", type=Path, required=True, metavar="FILE", help="CSV file")
    parser.add_argument("--seed", type=int, default=10, metavar="N", help="default: %(default)s")
    parser.add_argument(
        "--decisions", type=int, metavar="N", help=f"joint decisions of training (default: {DECISIONS})"
    )
    parser.add_argument("--episodes", type=int, default=1000, metavar="N", help="of scores (default: %(default)s)")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line ``arguments``, those of the process if None, and return the exit code."""
    options = parse_arguments(arguments)
    try:
        check_file("--output", options.output)
        if options.decisions is not None and options.decisions < LEAST_DECISIONS:
            raise ValueError(f"--decisions {options.decisions} must be at least {LEAST_DECISIONS}")
        check_libraries()
    except (ValueError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    for name in options.learners:
        train, action_type, policies = LEARNERS[name]
        decisions = options.decisions or DECISIONS[name]
        seed_everything(options.seed)
        begin = process_time()
        act = train(options.seed, decisions)
        cost = {"joint_decisions": decisions, "cpu_seconds": round(process_time() - begin, 1)}
        for greedy in policies:
            row = {"learner": name, "seed": options.seed, **cost, "actions": "greedy" if greedy else "sampled"}
            rows.append({**row, **score(act, action_type, greedy, options.episodes)})
            Console().print(rows[-1])
        # After every learner: each takes minutes.
        atomic_write(options.output, csv_bytes([[*rows[0]], *([*row.values()] for row in rows)]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
