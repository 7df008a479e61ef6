"""CPU time to a result, beside Stable-Baselines3's PPO and morl-baselines' NLMOPPO.

    python scripts/wall_clock.py --output wall_clock.csv

Each learner trains on OneWaypoint under the paper's linear utility until its greedy policy arrives in 95% of 200
episodes of the validation split, after five updates in a row; and for a fixed CPU time on CartPole-v1, for its speed.
All have the same settings, one thread and the same number of environments; every run is a new process, and learners
take turns. Evaluations and compilation do not count. The peers need the extra ``[peers]``; docs/benchmark.md explains
the table.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Annotated, Any

import gymnasium
import mo_gymnasium
import numpy as np
import paired_benchmark
import torch
from gymnasium import spaces
from gymnasium.envs.classic_control import CartPoleEnv
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv
from result_file import check_folder, check_least, write_results
from rich.console import Console
from rich.progress import track
from rich.table import Table

from algorithms import ALGORITHMS
from algorithms.experiments.cli import make_parser
from algorithms.experiments.config import make_experiment
from algorithms.networks.threads import set_threads
from algorithms.peers import PEERS
from algorithms.peers.running import prepare
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.metrics import SUCCESS
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.wrappers import UtilityReward

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from algorithms.peers import PeerTask
    from mo_deepdrive.evaluation.function_policy import PolicyFunction
    from mo_deepdrive.evaluation.policy import Policy

ONE_WAYPOINT, CARTPOLE = "mo-deepdrive-one-waypoint-v0", "CartPole-v1"
VECTOR_CARTPOLE = "mo-deepdrive-benchmark-cartpole-v0"
UTILITY = "one_waypoint_linear"
TARGET, EPISODES = 0.95, 200
HELD = 5  # updates after which it counts as reached, so that one lucky policy is not enough
ENDLESS = 10**9

# The settings of all learners: this package's defaults.
ENVS, STEPS, HIDDEN = 256, 16, [64, 32]
LEARNING_RATE, GAMMA, GAE_LAMBDA, CLIP, EPOCHS, MINIBATCHES, ENTROPY = 1e-3, 0.99, 0.95, 0.2, 4, 4, 0.01


class VectorCartPole(CartPoleEnv):
    """CartPole with its reward as a vector (1,), which multi-objective algorithms need."""

    def __init__(self, **options: Any):
        super().__init__(**options)
        self.reward_space = spaces.Box(0.0, 1.0, (1,), dtype=np.float32)
        self.reward_dim = 1

    def step(self, action: Any) -> Any:
        """Take one step; the reward is a vector (1,)."""
        observation, reward, terminated, truncated, info = super().step(action)  # type: ignore[no-untyped-call]
        return observation, np.array([reward], dtype=np.float32), terminated, truncated, info


gymnasium.register(VECTOR_CARTPOLE, VectorCartPole, max_episode_steps=500)


class Finished(Exception):
    """Training has reached its result or its limit."""


class Stopwatch:
    """Measures the CPU time of a training loop that calls it after every update.

    Args:
        limit: CPU seconds, after which training is finished.
        done: whether a policy is good enough; asked after every update, off the clock.

    Attributes:
        seconds: CPU time until now; once the result is reached, until the first of the :data:`HELD` good policies.
        steps: environment steps likewise.
        reached: whether the result has been reached: :data:`HELD` good policies, one update after the other.
    """

    def __init__(self, limit: float, done: Callable[[Policy | PolicyFunction], bool] | None = None):
        self.seconds, self.steps, self.reached = 0.0, 0, False
        self._limit, self._done = limit, done
        self._good: list[tuple[float, int]] = []  # time and steps of the latest policies, as far as they are good
        self._started = process_time()

    def start(self) -> None:
        """Begin to measure."""
        self._started = process_time()

    def lap(self, steps: int, policy: Policy | PolicyFunction) -> None:
        """Note that ``steps`` have been taken in all, and that ``policy`` is what has been learnt.

        Raises:
            Finished: if that is the result, or the limit is reached.
        """
        self.seconds += process_time() - self._started
        self.steps = steps
        if self._done is not None:
            self._good = [*self._good, (self.seconds, steps)] if self._done(policy) else []
        if len(self._good) == HELD:
            self.reached = True
            self.seconds, self.steps = self._good[0]
        if self.reached or self.seconds >= self._limit:
            raise Finished
        self._started = process_time()


def arrives(policy: Policy | PolicyFunction) -> bool:
    """Whether the greedy policy arrives in 95% of the first episodes of the validation split."""
    env = make_env(ONE_WAYPOINT, EPISODES)
    try:
        found = evaluate(policy, env, episodes=EPISODES, utility=UTILITY, gamma=GAMMA)
    finally:
        env.close()
    return found.metrics()[SUCCESS] >= TARGET


# ---------------------------------------------------------------------------------------------------------- learners


def train_ours(algorithm: str, env_id: str, seed: int, watch: Stopwatch) -> None:
    """An algorithm of this package until the stopwatch ends it."""
    env: Any = make_env(VECTOR_CARTPOLE if env_id == CARTPOLE else env_id, ENVS)
    if env_id == CARTPOLE:
        utility = make_utility("linear", ("objective_0",), weights=[1.0])
    else:
        utility = make_utility(UTILITY, env.unwrapped.objectives)
    agent = ALGORITHMS[algorithm](
        env,
        utility,
        seed=seed,
        hidden=HIDDEN,
        steps=STEPS,
        learning_rate=LEARNING_RATE,
        gamma=GAMMA,
        gae_lambda=GAE_LAMBDA,
        clip=CLIP,
        epochs=EPOCHS,
        minibatches=MINIBATCHES,
        entropy_start=ENTROPY,
        entropy_end=ENTROPY,
    )

    def after_update(trained: Any) -> bool:
        watch.lap(trained.step, trained)
        return False

    watch.start()
    agent.train(ENDLESS, after_update=after_update)


def train_sb3(env_id: str, seed: int, watch: Stopwatch) -> None:
    """Stable-Baselines3's PPO until the stopwatch ends it."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import DummyVecEnv

    scales: Any = 1.0
    if env_id == CARTPOLE:
        env: Any = make_vec_env(CARTPOLE, ENVS, seed=seed)
    else:
        task = peer_task("stable_baselines3.ppo", seed)
        utility, scales = task.utility, task.observation_scales
        assert utility is not None

        def make_single(index: int) -> Any:
            return lambda: UtilityReward(task.make(index, recorded=False, scaled_rewards=False), utility, "return")

        env = DummyVecEnv([make_single(index) for index in range(ENVS)])

    class AfterUpdate(BaseCallback):  # type: ignore[misc]  # the library may be absent
        def _on_rollout_start(self) -> None:
            if self.num_timesteps:  # not before the first
                watch.lap(self.num_timesteps, act)

        def _on_step(self) -> bool:
            return True

    model = PPO(
        "MlpPolicy",
        env,
        seed=seed,
        device="cpu",
        n_steps=STEPS,
        batch_size=ENVS * STEPS // MINIBATCHES,
        n_epochs=EPOCHS,
        learning_rate=LEARNING_RATE,
        gamma=GAMMA,
        gae_lambda=GAE_LAMBDA,
        clip_range=CLIP,
        ent_coef=ENTROPY,
        policy_kwargs={"net_arch": HIDDEN, "activation_fn": torch.nn.ReLU},
    )

    def act(observations: Any, _accrued: Any, _discounts: Any) -> Any:
        return model.predict(observations / scales, deterministic=True)[0]

    watch.start()
    model.learn(ENDLESS, callback=AfterUpdate())


def train_nl_mo_ppo(env_id: str, seed: int, watch: Stopwatch) -> None:
    """morl-baselines' non-linear MO-PPO until the stopwatch ends it."""
    from morl_baselines.single_policy.ser.nl_mo_ppo import NLMOPPO, layer_init

    utility: Callable[[Any], Any]
    observation_scales: Any = 1.0
    reward_scales: Any = 1.0
    if env_id == CARTPOLE:
        makers = [lambda: mo_gymnasium.make(VECTOR_CARTPOLE)] * ENVS

        def utility(returns: Any) -> Any:
            return returns.sum()
    else:
        task = peer_task("morl_baselines.nl_mo_ppo", seed)
        makers = [partial(task.make, index, recorded=False) for index in range(ENVS)]
        utility = task.utility_of_scaled
        observation_scales, reward_scales = task.observation_scales, task.reward_scales

    def network(inputs: int, outputs: int, std: float) -> torch.nn.Sequential:
        layers: list[torch.nn.Module] = []
        for size in HIDDEN:
            layers += [layer_init(torch.nn.Linear(inputs, size)), torch.nn.ReLU()]
            inputs = size
        return torch.nn.Sequential(*layers, layer_init(torch.nn.Linear(inputs, outputs), std=std))

    class Watched(NLMOPPO):  # type: ignore[misc]  # the library may be absent
        updates = 0

        def reset_agent(self, pref_dim: int) -> None:
            """Make networks of our sizes; the library's have fixed ones."""
            super().reset_agent(pref_dim)
            inputs = self.agent.actor[0].in_features
            self.agent.actor = network(inputs, self.envs.single_action_space.n, std=0.01)
            self.agent.critic = network(inputs, self.num_objectives, std=1.0)
            self.optimizer = torch.optim.Adam(self.agent.parameters(), lr=self.learning_rate, eps=1e-5)

        def update(self) -> Any:
            """Learn from a rollout."""
            losses = super().update()
            self.updates += 1
            watch.lap(self.updates * self.batch_size, act)
            return losses

    learner = Watched(
        0,
        MOSyncVectorEnv(iter(makers)),
        total_timesteps=ENDLESS,
        num_steps=STEPS,
        learning_rate=LEARNING_RATE,
        anneal_lr=False,
        gamma=GAMMA,
        gae_lambda=GAE_LAMBDA,
        clip_coef=CLIP,
        num_minibatches=MINIBATCHES,
        update_epochs=EPOCHS,
        ent_coef=ENTROPY,
        device="cpu",
        seed=seed,
    )

    @torch.inference_mode()
    def act(observations: Any, accrued: Any, _discounts: Any) -> Any:
        seen = torch.as_tensor(observations / observation_scales, dtype=torch.float32)
        so_far = torch.as_tensor(accrued / reward_scales, dtype=torch.float32)
        return learner.agent.get_greedy_action(seen, so_far).numpy()

    watch.start()
    learner.train(None, utility)


def peer_task(name: str, seed: int) -> PeerTask:
    """OneWaypoint as peers see it."""
    values = {
        "environment": {"id": ONE_WAYPOINT},
        "utility": {"name": UTILITY},
        "algorithm": {"name": name, "gamma": GAMMA},
        "training": {"total_timesteps": ENDLESS, "num_envs": ENVS, "seed": seed},
    }
    return prepare(make_experiment(values), lambda _step, _metrics: None)


LEARNERS: dict[str, Callable[[str, int, Stopwatch], None]] = {
    "mo_ppo": partial(train_ours, "mo_ppo"),
    "ppo": partial(train_ours, "ppo"),
    "stable_baselines3.ppo": train_sb3,
    "morl_baselines.nl_mo_ppo": train_nl_mo_ppo,
}


# ---------------------------------------------------------------------------------------------------------- the table


@dataclass(frozen=True)
class Result:
    """One run.

    Attributes:
        learner: its name in :data:`LEARNERS`.
        environment: where it learnt.
        seed: of the run.
        reached: whether it arrived in 95% of the episodes; never on CartPole, where only speed is measured.
        seconds: CPU time until then, or of the whole run.
        steps: environment steps likewise.
    """

    learner: str
    environment: str
    seed: int
    reached: bool
    seconds: Annotated[float, ".6g"]
    steps: int


def race(learner: str, env_id: str, seed: int, limit: float) -> Result:
    """Train ``learner`` in this process until it arrives or for ``limit`` CPU seconds."""
    set_threads(1)
    watch = Stopwatch(limit, arrives if env_id == ONE_WAYPOINT else None)
    for each in (Stopwatch(0.0), watch):  # a first update, which compiles or loads what is compiled, does not count
        torch.manual_seed(seed)  # peers use the global generators
        np.random.seed(seed)  # noqa: NPY002
        with contextlib.suppress(Finished):
            LEARNERS[learner](env_id, seed, each)
    return Result(learner, env_id, seed, watch.reached, watch.seconds, watch.steps)


def race_in_new_process(arguments: tuple[str, str, int, float]) -> Result:
    """:func:`race` in a process of its own with one thread."""
    with paired_benchmark.one_thread_each(), multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(race, arguments)


def summary(results: Sequence[Result], learner: str) -> list[str]:
    """The learner's row of the table: CPU seconds and steps to the result, and steps per CPU second in both places."""
    mine = [result for result in results if result.learner == learner]
    driving = [result for result in mine if result.environment == ONE_WAYPOINT]
    # A run that did not arrive took longer than every number, so that the median is that of all runs.
    seconds = [result.seconds if result.reached else math.inf for result in driving]
    steps = [result.steps if result.reached else math.inf for result in driving]
    rates = [
        np.median([result.steps / result.seconds for result in mine if result.environment == env_id] or [math.nan])
        for env_id in (ONE_WAYPOINT, CARTPOLE)
    ]
    reached = sum(result.reached for result in driving)
    texts = [_text(rate, "{:,.0f}") for rate in rates]
    return [learner, f"{reached} of {len(driving)}", _range(seconds, "{:.1f}"), _range(steps, "{:,.0f}"), *texts]


def _range(values: Sequence[float], form: str) -> str:
    """The median with the least and the greatest; "not reached" for infinite ones."""
    if not values:
        return "-"
    median, low, high = (_text(value, form) for value in (np.median(values), min(values), max(values)))
    return median if low == high else f"{median} ({low} to {high})"


def _text(value: float, form: str) -> str:
    return "-" if math.isnan(value) else form.format(value) if math.isfinite(value) else "not reached"


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="number of runs of each learner (default: %(default)s)")
    parser.add_argument(
        "--limit", type=float, default=10.0, help="CPU minutes of a run on OneWaypoint (default: %(default)s)"
    )
    parser.add_argument(
        "--cartpole", type=float, default=10.0, help="CPU seconds of a run on CartPole (default: %(default)s)"
    )
    parser.add_argument("--only", nargs="+", choices=LEARNERS, default=list(LEARNERS), help="learners; default: all")
    parser.add_argument("--output", type=Path, help="also write every run to this CSV file")
    arguments = parser.parse_args(argv)
    check_least(parser, arguments, 1, "seeds")
    for name in ("limit", "cartpole"):
        if not getattr(arguments, name) > 0.0:
            parser.error(f"--{name} {getattr(arguments, name)} must be positive")
    check_folder(parser, arguments.output)
    for name in arguments.only:
        reason = PEERS[name].unavailable_reason() if name in PEERS else None
        if reason is not None:
            parser.error(f"{name} cannot run here: {reason}")
    limits = {ONE_WAYPOINT: 60.0 * arguments.limit, CARTPOLE: arguments.cartpole}
    runs = [
        (learner, env_id, seed, limits[env_id])
        for seed, env_id, learner in product(range(arguments.seeds), limits, arguments.only)
    ]
    about = {"commit": paired_benchmark.working_tree(), "machine": paired_benchmark.machine()}
    about["threads"] = str(paired_benchmark.THREADS)
    results = []
    for run in track(runs):
        results.append(race_in_new_process(run))
        write_results(arguments.output, results, about)  # after every run: all of them take hours
    columns = ("learner", "reached", "CPU seconds to 95%", "steps to 95%", "steps/s", "steps/s, CartPole-v1")
    caption = f"{arguments.seeds} seeds: median (least to greatest); {paired_benchmark.machine()}, one thread"
    table = Table(*columns, caption=caption)
    table.columns[0].no_wrap = True
    for learner in arguments.only:
        table.add_row(*summary(results, learner))
    Console().print(table)


if __name__ == "__main__":
    main()
