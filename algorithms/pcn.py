"""PCN: Pareto Conditioned Networks (Reymond, Bargiacchi and Nowé 2022), for a utility that is not known yet.

One network is conditioned on a command (R, h): the discounted return R in R^d that is still to be collected, and the
number h of decisions in which to collect it. It is trained by supervised learning to take the actions of past episodes
that achieved what the command asks for. With returns-to-go R_t and lengths T of episodes drawn uniformly from a buffer,
and time steps t drawn uniformly from each,

    L = -E[log pi(a_t | s_t, R_t, T - t)]                                    discrete actions      (1)
    L =  E[|a_t - tanh f(s_t, R_t, T - t)|^2 / k]                            k continuous axes     (2)

New episodes follow commands that ask for more than a non-dominated episode i of the buffer achieved (section 4):

    R = R_0^i + e_k x,  x ~ U(0, return_noise * std_k),    h = max(T^i - horizon_reduction, 1)     (3)

with a random objective k and the standard deviation std_k over the non-dominated episodes. After a reward r the command
becomes

    R <- (R - r) / gamma,    h <- max(h - 1, 1),                                                   (4)

and the network sees R clipped to the range of the returns-to-go in the buffer, extended by the command itself.

Objective: none under a utility. A front is learnt by imitation of non-dominated episodes, and assumes that the
environment is deterministic, in which the expected utility of the return (ESR) of a greedy policy is the utility of the
expected return (SER). Differences from the paper: N commands are followed in parallel, one per environment; eq. 4
divides by gamma, without which commands are inconsistent under a discount, and clips; inputs of the network are divided
by nominal scales or, in other libraries' environments, which have none unless ``objective_scales`` gives them,
standardised by their means and standard deviations in the warm-up; a buffer that is full of non-dominated episodes
keeps a subset that covers them; some episodes end with random actions (``exploration``), as in Go-Explore (Ecoffet et
al. 2021), without which a network that has learnt to repeat the episodes of the buffer finds no others; random actions
may repeat (``persistence``); continuous actions (eq. 2) have Gaussian exploration noise.
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from algorithms.agent import DRAWS, FrontAgent, PolicyOfFront
from algorithms.hyperparameters import (
    FinalLearningRate,
    HiddenSizes,
    LearningRate,
    NonNegative,
    Positive,
    PositiveFraction,
    Scales,
    linear_schedule,
    schedules,
)
from algorithms.learning.actors import check_outputs
from algorithms.learning.checkpoints import strip_prefix
from algorithms.learning.learner import NORM, Learner, Networks
from algorithms.learning.losses import Loss
from algorithms.learning.networks import CommandNetwork
from mo_deepdrive.evaluation import metrics
from mo_deepdrive.evaluation.pareto import crowding_distances, farthest_point_subset, non_dominated
from mo_deepdrive.evaluation.policy import SMALLEST_DISCOUNT, AccruedReward
from mo_deepdrive.support.faults import check_numbers
from mo_deepdrive.world.config import Settings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from gymnasium.vector import VectorEnv
    from numpy.typing import ArrayLike, NDArray


HORIZON = "horizon"

AtLeastOne = Annotated[int, Field(ge=1)]


class PCNConfig(Settings):
    """Hyperparameters of PCN."""

    learning_rate: LearningRate = 1e-3
    """Adam's step size at the start of training."""
    learning_rate_end: FinalLearningRate | None = None
    """Adam's step size at the end, to which it moves linearly; None for a constant one."""
    gamma: PositiveFraction = 0.99
    """Discount of the returns that commands ask for."""
    hidden: HiddenSizes = [64, 64]
    """Width of the two embeddings, then of the layers after them."""
    batch_size: AtLeastOne = 256
    """Time steps of a gradient step."""
    gradient_steps: AtLeastOne = 100
    """Gradient steps per update; an update also collects one episode per environment."""
    warmup_episodes: AtLeastOne = 32
    """Minimum number of episodes of random actions before the first update."""
    persistence: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Probability that a random action repeats the previous one."""
    exploration: Annotated[float, Field(ge=0.0, le=1.0)] = 0.2
    """Probability that an episode continues with random actions from a random decision on."""
    buffer_size: Annotated[int, Field(ge=2)] = 100
    """Episodes kept."""
    crowding: NonNegative = 0.2
    """Crowding distance up to which episodes of the buffer count as too similar."""
    return_noise: NonNegative = 1.0
    """Largest increase of the desired return, in standard deviations (eq. 3)."""
    horizon_reduction: Annotated[int, Field(ge=0)] = 2
    """Decisions by which the desired horizon is shorter than the episode's (eq. 3)."""
    action_noise: NonNegative = 0.1
    """Standard deviation of the exploration noise on continuous actions; discrete ones are sampled."""
    objective_scales: Scales | None = None
    """Nominal size of each objective's return, by which distances between returns are measured and commands divided;
    None for the environment's own or, if it has none, distances in units of 1 and standardised inputs."""
    horizon_scale: Positive = 100.0
    """Nominal number of decisions of an episode, where inputs are not standardised."""
    max_policies: AtLeastOne = 100
    """Largest size of a front; a subset that covers it represents a larger one."""


class PCN(FrontAgent):
    """Pareto Conditioned Networks.

    The arguments are those of :class:`algorithms.agent.Agent` without ``utility``, for an environment of one vehicle.

    Attributes:
        bounds: (2, d) the lowest and highest returns-to-go in the buffer.
        inputs: shift and scale (2, o + d + 1) of observations and commands before they enter the network.
    """

    name = "pcn"
    Config = PCNConfig
    varying_shapes = ("store.", "attained.")

    def __init__(self, env: VectorEnv, **options: Any):
        super().__init__(env, **options)
        if HORIZON in self.env.objectives:
            raise ValueError(f"an objective is named {HORIZON!r}, as a part of the commands of 'pcn'; rename it")
        if self.env.repeats is False:
            warnings.warn(
                f"{self.env.name} draws its scenarios: PCN imitates single episodes, whose returns may be luck, so fix "
                "them (fixed_destination, fixed_obstacle), or take conditioned_mo_ppo",
                stacklevel=2,
            )
        if self.env.vehicles != 1:
            raise ValueError(f"algorithm 'pcn' drives one vehicle; the environment has {self.env.vehicles}")
        config, d = self.config, len(self.env.objectives)
        self.scales = self.env.chosen_objective_scales(config.objective_scales)
        # Random episodes say little of the returns of good ones: scales that are known are better.
        self._standardises = not (self.env.native or config.objective_scales)
        sizes = self.env.observation_size, d + 1, config.hidden, self.env.actions
        self.network = CommandNetwork(*sizes, self.initial, standardised=self._standardises)
        self.learner = Learner([Networks(network=self.network)], math.inf, self.name)
        self.learners = [self.learner]
        self.buffer = EpisodeBuffer(config.buffer_size, self.scales, config.crowding)
        self.bounds = np.zeros((2, d), dtype=np.float32)
        self.draws = torch.Generator().manual_seed(self.seed_of(DRAWS))  # of commands, random actions and batches
        self._collected = 0  # episodes
        # Returns and lengths of the best episodes, where the policy was loaded without the buffer.
        self._attained: tuple[NDArray[np.float64], NDArray[np.int64]] | None = None
        scales = np.array([*self.env.observation_scales, *self.scales, config.horizon_scale], dtype=np.float32)
        self.inputs = np.stack([np.zeros_like(scales), scales])

    @property
    def schedules(self) -> list[str]:
        """That of the learning rate."""
        return schedules(self.config)

    # ------------------------------------------------------------------------------------------------------ the update

    def begin(self) -> None:
        """Fill the buffer with episodes of random actions."""
        while self._collected < self.config.warmup_episodes:
            self.draws.manual_seed(self.seed_of(DRAWS))
            self._collect(None)
        if self._standardises:
            self._standardise()

    def _standardise(self) -> None:
        """Shift and scale inputs to mean 0 and standard deviation 1 in the buffer; constant ones keep their scale."""
        rows = self.buffer.decisions()
        # A rare value is at most ten scales away, however small its share in the deviation.
        deviation = np.maximum(rows.std(axis=0), np.ptp(rows, axis=0) / 10.0)
        check_numbers({"largest deviation of observations and returns in the warm-up": deviation.max()})
        varies = deviation > 1e-6 * self.inputs[1]
        self.inputs = np.stack([rows.mean(axis=0), np.where(varies, deviation, self.inputs[1])]).astype(np.float32)

    def update(self, progress: float) -> dict[str, float]:
        """Follow one command per environment for an episode, then imitate the buffer; the losses by name.

        The command error is that of all episodes, also of those that exploration ended with random actions.
        """
        config = self.config
        self.draws.manual_seed(self.seed_of(DRAWS))
        commands = self._sample_commands()
        attained = self._collect(commands)
        learning_rate = linear_schedule(config.learning_rate, config.learning_rate_end, progress)
        rate = torch.tensor(learning_rate)
        steps = [self.learner.minimise(self.loss, self._batch(), [], rate) for _ in range(config.gradient_steps)]
        losses = {name: float(torch.cat([step[name] for step in steps]).mean()) for name in steps[0]}
        check_numbers(losses)
        del losses[NORM]
        return {
            **losses,
            metrics.LEARNING_RATE: learning_rate,
            metrics.COMMAND_ERROR: float((np.abs(attained - commands[:, :-1]) / self.scales).mean()),
            metrics.NON_DOMINATED: float(len(self.buffer.best())),
        }

    def _batch(self) -> dict[str, Tensor]:
        """A batch of the buffer (1, n, ...), as :meth:`loss` takes it."""
        observations, actions, returns, left = self.buffer.sample(self.config.batch_size, self.draws)
        batch = (*self._scaled(observations, returns, left), actions)
        names = "observations", "commands", "actions"
        return {name: torch.from_numpy(each).unsqueeze(0) for name, each in zip(names, batch, strict=True)}

    def loss(self, networks: Networks, samples: dict[str, Tensor]) -> Loss:
        """L of eq. 1 or 2."""
        outputs, actions = networks.network(samples["observations"], samples["commands"]), samples["actions"]
        if self.env.continuous:
            total = nn.functional.mse_loss(outputs.tanh(), actions)
        else:
            total = nn.functional.cross_entropy(outputs, actions)
        return Loss(total, {metrics.POLICY_LOSS: total})

    def gradient_steps(self, total_timesteps: int) -> int:
        """How many there are in a training of episodes of usual length."""
        updates = total_timesteps / (self.env.num_envs * self.config.horizon_scale)
        return int(updates * self.config.gradient_steps)

    def _sample_commands(self) -> NDArray[np.float32]:
        """One command (N, d + 1) per environment, by eq. 3."""
        config, n = self.config, self.env.num_envs
        returns, lengths = self._best_episodes()
        chosen = torch.randint(len(returns), (n,), generator=self.draws).numpy()
        objective = torch.randint(returns.shape[1], (n,), generator=self.draws).numpy()
        noise = config.return_noise * torch.rand(n, generator=self.draws).numpy()
        desired = returns[chosen].astype(np.float32)
        desired[np.arange(n), objective] += noise * returns.std(axis=0)[objective]
        horizon = np.maximum(lengths[chosen] - config.horizon_reduction, 1)
        return np.column_stack([desired, horizon.astype(np.float32)])

    def _collect(self, commands: NDArray[np.float32] | None) -> NDArray[np.float32]:
        """Add one episode per environment, under commands or random, to the buffer; their discounted returns (N, d)."""
        env, n, d = self.env, self.env.num_envs, len(self.scales)
        accrued_reward = AccruedReward.begin(n, 1, d)
        random_from = np.full(n, np.inf) if commands is None else self._random_from(commands[:, -1])
        observations = env.reset(self.env_seed + n * self.updates)
        over = np.zeros(n, dtype=np.bool_)
        steps: list[tuple[NDArray[Any], ...]] = []
        for _ in env.decisions():
            previous = steps[-1][1][:, None] if steps else None
            if commands is None:
                actions = self._random_actions(previous)
            else:
                actions = self.act_under(commands, observations, accrued_reward, self.generator)
                random = (random_from <= len(steps)) & ~over
                if random.any():
                    actions[random] = self._random_actions(previous)[random]
            step = env.step(actions)
            ended = (step.terminated | step.truncated)[:, 0]
            steps.append((observations[:, 0], actions[:, 0], step.rewards[:, 0], ended, step.succeeded[:, 0]))
            accrued_reward.add(step.rewards, self.accrued_discount)
            over |= ended
            if over.all():
                break
            observations = step.observations

        seen, taken, rewards, ended, succeeded = (np.stack(column, axis=1) for column in zip(*steps, strict=True))
        last = ended.argmax(axis=1)  # an environment goes on with further episodes while others are in their first
        lengths = last + 1
        rewards[np.arange(len(steps)) > last[:, None]] = 0.0
        to_go = returns_to_go(rewards, self.accrued_discount)
        columns = seen, taken, to_go
        self.buffer.add([Episode(*(each[i, :length].copy() for each in columns)) for i, length in enumerate(lengths)])
        self.bounds = self.buffer.bounds()
        self.step += int(lengths.sum())
        self.updates += 1
        self._collected += n
        returns, succeeded = rewards.sum(axis=1, dtype=np.float64), succeeded[np.arange(n), last]
        sums = torch.from_numpy(np.column_stack([succeeded, lengths, returns]))[None, :, None]
        self.episodes.add(torch.ones(sums.shape[:-1], dtype=torch.bool), sums)
        return to_go[:, 0]

    def _random_from(self, horizon: NDArray[np.float32]) -> NDArray[np.float64]:
        """(N,) the decision from which on actions are random; infinite where they follow the command to the end."""
        if not self.config.exploration:
            return np.full(len(horizon), np.inf)
        chosen, when = torch.rand(2, len(horizon), generator=self.draws, dtype=torch.float64).numpy()
        return np.where(chosen < self.config.exploration, np.floor(when * horizon), np.inf)

    def _random_actions(self, previous: NDArray[Any] | None) -> NDArray[Any]:
        """Random actions (N, 1) or (N, 1, k), some of which repeat the ``previous`` ones."""
        n, k = self.env.num_envs, self.env.actions
        if self.env.continuous:
            actions = 2.0 * torch.rand(n, 1, k, generator=self.draws).numpy() - 1.0
        else:
            actions = torch.randint(k, (n, 1), generator=self.draws).numpy()
        if previous is not None:
            repeat = torch.rand(n, generator=self.draws).numpy() < self.config.persistence
            actions[repeat] = previous[repeat]
        return actions

    def _scaled(
        self, observations: NDArray[np.float32], desired: NDArray[np.float32], horizon: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Inputs of the network for observations (n, o) and commands (n, d) and (n,)."""
        command = np.concatenate([desired, horizon[:, None]], axis=1, dtype=np.float32)
        (shift, scale), o = self.inputs, self.env.observation_size
        return (observations - shift[:o]) / scale[:o], (command - shift[o:]) / scale[o:]

    # ---------------------------------------------------------------------------------------------------------- acting

    def act_under(
        self,
        commands: NDArray[np.float32],
        observations: NDArray[np.float32],
        accrued_reward: AccruedReward,
        generator: torch.Generator | None,
    ) -> NDArray[Any]:
        """Actions (N, 1) or (N, 1, k) for observations (N, 1, o); greedy where ``generator`` is None.

        The commands (N, d + 1), or (1, d + 1) for all, are the return and the decisions of the whole episode.
        """
        asked, (low, high) = commands[:, :-1], self.bounds
        # Equation 4, applied t times, and then the clip.
        desired = (asked - accrued_reward.value[:, 0]) / accrued_reward.discounts.clip(min=SMALLEST_DISCOUNT)
        horizon = np.maximum(commands[:, -1] - accrued_reward.decisions[:, 0], 1.0)
        desired = np.minimum(np.maximum(desired, np.minimum(low, asked)), np.maximum(high, asked))
        return self.choose_actions(observations[:, 0], desired, horizon, generator)[:, None]

    def choose_actions(
        self,
        observations: NDArray[np.float32],
        desired: NDArray[np.float32],
        horizon: NDArray[np.float32],
        generator: torch.Generator | None,
    ) -> NDArray[Any]:
        """Actions (N,) or (N, k) for observations (N, o), to get ``desired`` (N, d) in ``horizon`` (N,) decisions."""
        outputs = self.network.respond(*self._scaled(observations, desired, horizon))
        check_outputs(torch.from_numpy(outputs))
        if self.env.continuous:
            actions: NDArray[np.float32] = np.tanh(outputs)
            if generator is not None:
                noise = torch.randn(actions.shape, generator=generator, device=self.device).cpu().numpy()
                actions = np.clip(actions + self.config.action_noise * noise, -1.0, 1.0)
            return actions
        if generator is None:
            return np.asarray(outputs.argmax(axis=1))
        # By inversion: the first action whose cumulative probability is not below a uniform number in (0, 1].
        cumulative = np.exp(outputs - outputs.max(axis=1, keepdims=True)).cumsum(axis=1)
        uniform = 1.0 - torch.rand((len(outputs), 1), generator=generator, device=self.device).cpu().numpy()
        return np.asarray((cumulative < uniform * cumulative[:, -1:]).sum(axis=1))

    def eval(self, obs: NDArray[Any], desired_return: ArrayLike, desired_horizon: float) -> Any:
        """The greedy action, as the environment takes it, for one observation as it gives it.

        The discounted return (d,) is what is still to be collected, in so many decisions.
        """
        observations = self.env.policy_observations(np.asarray(obs)[None])[:, 0].astype(np.float32)
        desired = np.reshape(np.asarray(desired_return, dtype=np.float32), (1, -1))
        horizon = np.full(1, desired_horizon, dtype=np.float32)
        return self.env.environment_actions(self.choose_actions(observations, desired, horizon, None)[:, None])[0]

    # ------------------------------------------------------------------------------------------------------- the front

    def _best_episodes(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Discounted returns (K, d) and lengths (K,) of the non-dominated episodes: the buffer's, else the loaded."""
        if self._attained is not None and not len(self.buffer):
            return self._attained
        best = self.buffer.best()
        return self.buffer.returns[best], self.buffer.lengths[best]

    @property
    def condition_names(self) -> tuple[str, ...]:
        """Of a command: desired discounted returns and horizon."""
        return (*self.env.objectives, HORIZON)

    def conditions(self) -> NDArray[np.float32]:
        """(K, d + 1) commands: returns and lengths of the buffer's non-dominated episodes."""
        returns, lengths = self._best_episodes()
        chosen = farthest_point_subset(returns, self.config.max_policies, self.scales)
        return np.column_stack([returns[chosen], lengths[chosen]]).astype(np.float32)

    def policies(self, conditions: ArrayLike) -> PolicyOfFront:
        """The policy that follows commands (N, d + 1), one per environment, or the same (1, d + 1) in all.

        Raises:
            ValueError: if a command has the wrong shape, or asks for returns far outside those of the buffer.
        """
        commands = np.asarray(conditions, dtype=np.float32)
        names = self.condition_names
        if commands.ndim != 2 or commands.shape[1] != len(names):
            raise ValueError(f"commands of shape {commands.shape} must be (n, {len(names)}): {', '.join(names)}")
        if not (commands[:, -1] >= 1.0).all():
            raise ValueError(f"horizon = {commands[:, -1].min():g} must be at least 1 decision")
        low, high = self.bounds[0] - self.scales, self.bounds[1] + self.scales
        desired = commands[:, :-1]
        outside = np.argwhere(~((desired >= low) & (desired <= high)))
        if len(outside):
            row, k = outside[0]
            raise ValueError(
                f"desired return of {names[k]} = {desired[row, k]:g} is outside the range of past episodes; "
                f"it must be between {low[k]:g} and {high[k]:g}"
            )
        return PolicyOfFront(self, commands)

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must share; with other scales or another discount a command means something else."""
        return {
            **super().identity(),
            "hidden": list(self.config.hidden),
            "command_scales": [*self.scales.tolist(), self.config.horizon_scale],
            "gamma": self.accrued_discount,
        }

    def get_state(self) -> dict[str, Tensor]:
        """Network, optimiser, buffer and counts."""
        return {
            "counts": torch.tensor([self.updates, self._collected]),
            **self._policy_tensors(),
            **{name: each for name, each in self.learner.get_state().items() if name.startswith("optimiser.")},
            **{f"store.{name}": tensor for name, tensor in self.buffer.get_state().items()},
        }

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Resume from :meth:`get_state`."""
        self.set_policy(state)
        self.updates, self._collected = state["counts"].tolist()
        self.learner.set_state(state)

    def _policy_tensors(self) -> dict[str, Tensor]:
        """What acting under a command needs."""
        inputs = {"inputs": torch.from_numpy(self.inputs)} if self._standardises else {}
        return {"bounds": torch.from_numpy(self.bounds), **inputs, **self.learner.get_weights("network")}

    def get_policy(self) -> dict[str, Tensor]:
        """The network, and in place of the buffer the returns and lengths that commands are made of."""
        if self._attained is None and not len(self.buffer):
            return self._policy_tensors()
        returns, lengths = map(torch.from_numpy, self._best_episodes())
        return {**self._policy_tensors(), "attained.returns": returns.float(), "attained.lengths": lengths}

    def save_policy(self, path: str | Any) -> None:
        """Write only what acting needs, as :meth:`Agent.save_policy`; an empty buffer is refused."""
        self._best_episodes()
        super().save_policy(path)

    def set_policy(self, state: dict[str, Tensor]) -> None:
        """Act as the agent of :meth:`get_policy` or :meth:`get_state`."""
        self._attained = None
        if "attained.returns" in state:
            returns, lengths = state["attained.returns"].numpy(), state["attained.lengths"].numpy()
            self._attained = returns.astype(np.float64), lengths.astype(np.int64)
        self.learner.set_weights(state)
        self.bounds = state["bounds"].numpy()
        if self._standardises:
            self.inputs = state["inputs"].numpy()
        self.buffer.set_state(strip_prefix(state, "store."))


# ----------------------------------------------------------------------------------------------- the buffer (section 4)


class Episode(NamedTuple):
    """One episode of T decisions."""

    observations: NDArray[np.float32]  # (T, o) before each action
    actions: NDArray[Any]  # (T,) or (T, k)
    returns: NDArray[np.float32]  # (T, d) discounted returns-to-go; the first is the return of the episode


def returns_to_go(rewards: NDArray[np.float32], gamma: float) -> NDArray[np.float32]:
    """Discounted returns-to-go R_t = r_t + gamma R_{t+1} (..., T, d) of ``rewards`` (..., T, d)."""
    returns = rewards.astype(np.float64)
    for t in range(returns.shape[-2] - 2, -1, -1):
        returns[..., t, :] += gamma * returns[..., t + 1, :]
    return returns.astype(np.float32)


class EpisodeBuffer:
    """The best episodes so far: close to the non-dominated ones, and diverse.

    An episode's score is minus its distance to the nearest non-dominated return, in units of ``scales``. The distance
    is doubled where the crowding distance is at most ``crowding``, and slightly larger for all but the first of equal
    returns. When there are more than ``capacity`` episodes, those with the lowest scores are removed; when more than
    ``capacity`` are non-dominated, a farthest-point subset of them is kept.
    """

    REPEATED = 1e-5  # units of ``scales``

    def __init__(self, capacity: int, scales: NDArray[np.float32], crowding: float):
        self.capacity, self.crowding = capacity, crowding
        self.scales = np.asarray(scales, dtype=np.float64)
        self.episodes: list[Episode] = []
        self._arrays: dict[str, NDArray[Any]] = {}

    def __len__(self) -> int:
        return len(self.episodes)

    @property
    def returns(self) -> NDArray[np.float64]:
        """(E, d) discounted return of every episode."""
        return np.array([episode.returns[0] for episode in self.episodes], dtype=np.float64)

    @property
    def lengths(self) -> NDArray[np.int64]:
        """(E,) decisions of every episode."""
        return np.array([len(episode.returns) for episode in self.episodes], dtype=np.int64)

    def add(self, episodes: list[Episode]) -> None:
        """Add ``episodes``, then remove the worst."""
        self.episodes += episodes
        if len(self.episodes) > self.capacity:
            kept = self.best()
            if len(kept) < self.capacity:
                kept = np.argsort(-self.scores(), kind="stable")[: self.capacity]
            else:
                kept = kept[farthest_point_subset(self.returns[kept], self.capacity, self.scales)]
            self.episodes = [self.episodes[i] for i in kept]
        self._arrays = {}

    def scores(self) -> NDArray[np.float64]:
        """(E,) scores; at most 0."""
        points = self.returns / self.scales
        best = points[non_dominated(points)]
        gaps = np.array([np.linalg.norm(best - point, axis=1).min() for point in points])
        _, first = np.unique(points, axis=0, return_index=True)
        repeated = np.ones(len(points), dtype=np.bool_)
        repeated[first] = False
        gaps[repeated] += self.REPEATED
        gaps[crowding_distances(points) <= self.crowding] *= 2.0
        return -gaps

    def best(self) -> NDArray[np.intp]:
        """Indices of the episodes with non-dominated returns."""
        if not self.episodes:
            raise ValueError("the buffer holds no episode yet: train first, or load a checkpoint")
        return np.flatnonzero(non_dominated(self.returns))

    def bounds(self) -> NDArray[np.float32]:
        """(2, d) lowest and highest return-to-go."""
        returns = self._flat()["returns"]
        return np.stack([returns.min(axis=0), returns.max(axis=0)])

    def decisions(self) -> NDArray[np.float32]:
        """(D, o + d + 1) observation, return-to-go and number of decisions left at every time step."""
        flat = self._flat()
        left = np.repeat(flat["starts"] + flat["lengths"], flat["lengths"]) - np.arange(len(flat["returns"]))
        return np.column_stack([flat["observations"], flat["returns"], left.astype(np.float32)])

    def sample(self, count: int, generator: torch.Generator) -> tuple[NDArray[Any], ...]:
        """Observations (n, o), actions, returns-to-go (n, d) and decisions left (n,) at random time steps.

        Every episode is equally likely, whatever its length.
        """
        flat = self._flat()
        chosen = torch.randint(len(self), (count,), generator=generator).numpy()
        lengths = flat["lengths"][chosen]
        t = (torch.rand(count, generator=generator).numpy() * lengths).astype(np.int64)
        rows = flat["starts"][chosen] + t
        return *(flat[name][rows] for name in Episode._fields), (lengths - t).astype(np.float32)

    def _flat(self) -> dict[str, NDArray[Any]]:
        if not self._arrays:
            columns, lengths = map(np.concatenate, zip(*self.episodes, strict=True)), self.lengths
            self._arrays = dict(zip(Episode._fields, columns, strict=True))
            self._arrays |= {"lengths": lengths, "starts": np.cumsum(lengths) - lengths}
        return self._arrays

    def get_state(self) -> dict[str, Tensor]:
        """All episodes as a few tensors."""
        flat = self._flat() if self.episodes else {}
        return {name: torch.from_numpy(np.ascontiguousarray(flat[name])) for name in flat if name != "starts"}

    def set_state(self, state: Mapping[str, Tensor]) -> None:
        """Resume from :meth:`get_state`."""
        self.episodes, self._arrays = [], {}
        if state:
            lengths = state["lengths"].tolist()
            columns = [state[name].split(lengths) for name in Episode._fields]
            self.episodes = [Episode(*(part.numpy() for part in parts)) for parts in zip(*columns, strict=True)]
