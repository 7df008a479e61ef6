"""Pareto Conditioned Networks: one network that obeys commands, and with it a front (Reymond et al. 2022).

The utility is unknown. The policy sees a command, the return that is wanted from here on and the decisions that are
left for it, and learns by supervised learning to do what past episodes did that got it. New episodes follow commands
that ask for a little more than the best ones so far. Assumes that the environment is deterministic.

Ours differs from the paper's in that N commands are tried side by side, one per world, and in that the wanted return is
kept consistent under a discount: after r it is (R - r) / gamma.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator
from torch import nn

from algorithms.agent import Agent, EvaluationPlan
from algorithms.common.accrued_reward import AccruedReward
from algorithms.common.checkpoints import below
from algorithms.common.env_adapter import EnvAdapter
from algorithms.common.episode_buffer import Episode, EpisodeBuffer, returns_to_go
from algorithms.common.networks import CommandNetwork
from algorithms.common.optimisers import linear, optimiser_state, set_optimiser_state
from algorithms.common.pareto import farthest_point_subset, indicators
from algorithms.evaluation.evaluate import Evaluation, evaluate_each
from algorithms.evaluation.front import Front
from mo_deepdrive.config import Settings
from mo_deepdrive.utilities import Utility

HORIZON = "horizon"


class PCNConfig(Settings):
    """Hyperparameters of PCN.

    Attributes:
        learning_rate, learning_rate_end: Adam's step size, moving linearly from one to the other (None: constant).
        gamma: discount of the returns that commands ask for.
        hidden: width of the two embeddings, then of the layers after them.
        batch_size: decisions of a gradient step.
        gradient_steps: gradient steps after every round of episodes, one episode per world.
        warmup_episodes: episodes of random actions at the beginning.
        persistence: chance that a random action is the one before once more.
        buffer_size: episodes kept.
        crowding: crowding distance below which episodes of the store are too much alike.
        return_noise: how much more a command asks for in one objective, in standard deviations over the non-dominated
            episodes: uniform between 0 and this.
        horizon_reduction: how many decisions fewer a command leaves than its episode took.
        action_noise: deviation of exploring actions, continuous ones only; discrete ones are sampled.
        objective_scales: nominal size of each objective's return; None for the environment's own.
        horizon_scale: nominal number of decisions of an episode.
        max_policies: the policies of a front at most; where the store knows more, those that cover them.
    """

    renamed = {
        "haste": "horizon_reduction",
        "ambition": "return_noise",
        "store_episodes": "buffer_size",
        "updates": "gradient_steps",
    }

    learning_rate: float = Field(default=1e-3, gt=0.0, le=1.0)
    learning_rate_end: float | None = Field(default=None, ge=0.0, le=1.0)
    gamma: float = Field(default=0.99, gt=0.0, le=1.0)
    hidden: list[int] = Field(default=[64, 64], min_length=1)
    batch_size: int = Field(default=256, ge=1)
    gradient_steps: int = Field(default=50, ge=1)
    warmup_episodes: int = Field(default=64, ge=1)
    persistence: float = Field(default=0.0, ge=0.0, lt=1.0)
    buffer_size: int = Field(default=256, ge=2)
    crowding: float = Field(default=0.2, ge=0.0)
    return_noise: float = Field(default=1.0, ge=0.0)
    horizon_reduction: int = Field(default=2, ge=0)
    action_noise: float = Field(default=0.1, ge=0.0)
    objective_scales: list[float] | None = None
    horizon_scale: float = Field(default=100.0, gt=0.0)
    max_policies: int = Field(default=100, ge=1)

    @model_validator(mode="after")
    def _consistent(self) -> PCNConfig:
        if any(size < 1 for size in self.hidden):
            raise ValueError(f"hidden = {self.hidden} must be positive layer sizes")
        if self.objective_scales is not None and any(scale <= 0.0 for scale in self.objective_scales):
            raise ValueError(f"objective_scales = {self.objective_scales} must be positive")
        return self


@dataclass(frozen=True)
class CommandPolicy:
    """The agent under one command per world: a policy that can be evaluated.

    Attributes:
        agent: who obeys.
        desired: (N, d) discounted return that is wanted from the whole episode.
        horizon: (N,) decisions for it.
    """

    agent: PCN
    desired: NDArray[np.float32]
    horizon: NDArray[np.float32]

    @property
    def env(self) -> EnvAdapter:
        return self.agent.env

    @property
    def gamma(self) -> float:
        return self.agent.gamma

    @property
    def device(self) -> torch.device:
        return self.agent.device

    @property
    def utilities(self) -> tuple[Utility, ...]:
        return ()

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, 1) or (N, 1, k) for observations (N, 1, o); greedy where ``generator`` is None."""
        wanted = (self.desired - accrued_reward.value[:, 0]) / accrued_reward.discounts
        low, high = self.agent.bounds
        # What no decision was ever worth means nothing to the network, except that the command itself may ask for it.
        wanted = np.clip(wanted, np.minimum(low, self.desired), np.maximum(high, self.desired))
        left = np.maximum(self.horizon - accrued_reward.decisions[:, 0], 1.0)
        return self.agent.choose(observations[:, 0], wanted, left, generator)[:, None]


class PCN(Agent):
    """Pareto Conditioned Networks.

    Args:
        env: a vector environment with vector rewards and one vehicle, from `algorithms.common.env_adapter.make_env`.
        seed: determines the run, bit for bit on one machine.
        device: where the network lives.
        **hyperparameters: fields of PCNConfig.

    Attributes:
        bounds: (d,) least and greatest return that the store knows from any decision on.

    Raises:
        ValueError: for unknown or unfit hyperparameters or spaces.
    """

    name = "pcn"
    Config = PCNConfig
    known_utility = False

    def __init__(self, env: VectorEnv, *, seed: int = 0, device: str = "cpu", **hyperparameters: Any):
        super().__init__(env, seed=seed, device=device, hyperparameters=hyperparameters)
        if self.env.vehicles != 1:
            raise ValueError(f"algorithm 'pcn' drives one vehicle; the environment has {self.env.vehicles}")
        d = len(self.env.objectives)
        scales = self.env.objective_scales if self.config.objective_scales is None else self.config.objective_scales
        if len(scales) != d:
            raise ValueError(f"objective_scales = {list(scales)} needs {d} numbers: {self.env.objectives}")
        self.scales = np.asarray(scales, dtype=np.float32)
        self.network = CommandNetwork(
            self.env.observation_size, d + 1, self.config.hidden, self.env.actions, self._initial
        ).to(self.device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=self.config.learning_rate, fused=True)
        self.store = EpisodeBuffer(self.config.buffer_size, self.scales, self.config.crowding)
        self.bounds = np.zeros(d, dtype=np.float32), np.zeros(d, dtype=np.float32)
        # What the best episodes got, where a policy came without them.
        self._attained: tuple[NDArray[np.float64], NDArray[np.int64]] | None = None
        # Draws commands and batches.
        self._draws = torch.Generator().manual_seed(int(torch.randint(2**62, (1,), generator=self._initial)))
        self._rounds = 0
        self._seen = 0
        self._unlogged: list[NDArray[np.float64]] = []
        self._observation_scales = torch.tensor(self.env.observation_scales, device=self.device)
        self._command_scales = torch.tensor([*self.scales, self.config.horizon_scale], device=self.device)

    @property
    def updates(self) -> int:
        """Rounds of episodes so far."""
        return self._rounds

    # ------------------------------------------------------------------------------------------------------- policies

    @torch.inference_mode()
    def choose(
        self,
        observations: NDArray[np.float32],
        wanted: NDArray[np.float32],
        left: NDArray[np.float32],
        generator: torch.Generator | None,
    ) -> NDArray[Any]:
        """Actions (N,) or (N, k) for observations (N, o) when ``wanted`` (N, d) is asked for in ``left`` (N,)."""
        outputs = self._outputs(observations, wanted, left)
        if self.env.continuous:
            if generator is not None:
                noise = torch.randn(outputs.shape, generator=generator, device=self.device)
                outputs = (outputs + self.config.action_noise * noise).clamp(-1.0, 1.0)
            return outputs.cpu().numpy()
        if generator is not None:
            # The largest of logits plus Gumbel noise is a draw from their softmax.
            noise = torch.empty_like(outputs).exponential_(generator=generator).log()
            outputs = outputs - noise
        return outputs.argmax(-1).cpu().numpy()

    def _outputs(self, observations: NDArray, wanted: NDArray, left: NDArray) -> torch.Tensor:
        """Logits (n, actions), or continuous actions (n, k)."""
        command = np.concatenate([wanted, left[:, None]], axis=1, dtype=np.float32)
        outputs = self.network(
            torch.from_numpy(observations).to(self.device) / self._observation_scales,
            torch.from_numpy(command).to(self.device) / self._command_scales,
        )
        return outputs.tanh() if self.env.continuous else outputs

    def commanded(self, desired: ArrayLike, horizon: ArrayLike) -> CommandPolicy:
        """The policies that ``desired`` (N, d) discounted returns in ``horizon`` (N,) decisions make, one per world.

        Raises:
            ValueError: if a command is of the wrong shape, or asks for what is outside the scale of the store.
        """
        low, high = self.bounds
        wanted = np.atleast_2d(np.asarray(desired, dtype=np.float32))
        left = np.atleast_1d(np.asarray(horizon, dtype=np.float32))
        if wanted.shape != (len(left), len(self.scales)):
            raise ValueError(
                f"desired return of shape {wanted.shape} and horizon of shape {left.shape}: "
                f"expected (n, {len(self.scales)}) and (n,)"
            )
        if not (left >= 1.0).all():
            raise ValueError(f"horizon = {left.min():g} must be at least 1 decision")
        for i, objective in enumerate(self.env.objectives):
            least, most = low[i] - self.scales[i], high[i] + self.scales[i]
            outside = wanted[~((wanted[:, i] >= least) & (wanted[:, i] <= most)), i]
            if len(outside):
                raise ValueError(
                    f"desired return of {objective} = {outside[0]:g} is outside of what was ever seen; "
                    f"it must be between {least:g} and {most:g}"
                )
        return CommandPolicy(self, wanted, left)

    def policy(self, condition: ArrayLike) -> CommandPolicy:
        """The policy of a row (d + 1,) of a front's ``conditions``, in any number of worlds.

        Raises:
            ValueError: as :meth:`commanded`.
        """
        *desired, horizon = np.asarray(condition, dtype=np.float32).tolist()
        return self.commanded([desired], [horizon])

    def commands(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Commands (K, d) and (K,) that the front is made of: what the non-dominated episodes of the store got.

        Raises:
            ValueError: if the store is empty and no policy was loaded.
        """
        returns, lengths = self._best()
        chosen = farthest_point_subset(returns, self.config.max_policies, self.scales)
        return returns[chosen].astype(np.float32), lengths[chosen].astype(np.float32)

    def _best(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Discounted returns (K, d) and decisions (K,) of the best episodes: the store's, else the loaded policy's."""
        if self._attained is not None and not len(self.store):
            return self._attained
        return self.store.attained()

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Refused: which action is right depends on the command; see :meth:`commanded`."""
        raise TypeError("PCN acts under a command: agent.commanded(desired, horizon).act(...)")

    def eval(self, obs: NDArray[Any], desired_return: ArrayLike, desired_horizon: float) -> Any:
        """The greedy action for one observation.

        Args:
            obs: as one environment gives it.
            desired_return: (d,) discounted return that is wanted from here on.
            desired_horizon: decisions left for it.

        Returns:
            An action as the environment takes it.
        """
        observations = self.env.policy_observations(np.asarray(obs)[None])[:, 0].astype(np.float32)
        wanted = np.reshape(np.asarray(desired_return, dtype=np.float32), (1, -1))
        left = np.full(1, desired_horizon, dtype=np.float32)
        return self.env.environment_actions(self.choose(observations, wanted, left, None)[:, None])[0]

    # ------------------------------------------------------------------------------------------------------- learning

    def _begin(self) -> None:
        while self._seen < self.config.warmup_episodes:
            self._collect(None)

    def _update(self, progress: float) -> dict[str, float]:
        learning_rate = linear(self.config.learning_rate, self.config.learning_rate_end, progress)
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate
        policy = self._ambitious()
        attained = self._collect(policy)
        error = np.abs(attained - policy.desired) / self.scales
        losses = [self._learn() for _ in range(self.config.gradient_steps)]
        return {
            "loss/policy": float(torch.stack(losses).mean()),
            "policy/learning_rate": learning_rate,
            "policy/command_error": float(error.mean()),
            "policy/non_dominated": float(len(self.store.best())),
        }

    def _ambitious(self) -> CommandPolicy:
        """One command per world: a non-dominated episode's, with more of one objective in fewer decisions."""
        best = self.store.best()
        returns, n = self.store.returns[best], self.env.num_envs
        chosen = torch.randint(len(best), (n,), generator=self._draws).numpy()
        objective = torch.randint(returns.shape[1], (n,), generator=self._draws).numpy()
        more = self.config.return_noise * torch.rand(n, generator=self._draws).numpy()
        desired = returns[chosen].astype(np.float32)
        desired[np.arange(n), objective] += more * returns.std(axis=0)[objective]
        horizon = np.maximum(self.store.lengths[best][chosen] - self.config.horizon_reduction, 1)
        return CommandPolicy(self, desired, horizon.astype(np.float32))

    def _collect(self, policy: CommandPolicy | None) -> NDArray[np.float32]:
        """One episode per world under ``policy`` (None: random actions) into the store; the returns (N, d) they got."""
        worlds, n = self.env, self.env.num_envs
        accrued_reward = AccruedReward.begin(n, 1, len(self.scales))
        observations = worlds.reset(self._worlds_seed + n * self._rounds)
        running = np.ones(n, dtype=np.bool_)
        succeeded = np.zeros(n, dtype=np.bool_)
        lengths = np.zeros(n, dtype=np.int64)
        seen: list[tuple[NDArray, NDArray, NDArray]] = []
        while running.any():
            if policy is None:
                actions = self._random(seen[-1][1][:, None] if seen else None)
            else:
                actions = policy.act(observations, accrued_reward, self.generator)
            step = worlds.step(actions)
            seen.append((observations[:, 0], actions[:, 0], step.rewards[:, 0]))
            accrued_reward.add(step.rewards, self.gamma)
            lengths += running
            succeeded |= running & step.succeeded[:, 0]
            running &= ~(step.terminated | step.truncated)[:, 0]
            observations = step.observations
        columns = [np.stack(column, axis=1) for column in zip(*seen, strict=True)]
        episodes = []
        for i, length in enumerate(lengths):
            taken, done, rewards = (column[i, :length] for column in columns)
            episodes.append(Episode(taken.copy(), done.copy(), returns_to_go(rewards, self.gamma)))
            self._unlogged.append(np.array([succeeded[i], length, *rewards.sum(axis=0, dtype=np.float64)]))
        self.store.add(episodes)
        self.bounds = self.store.bounds()
        self.step += int(lengths.sum())
        self._rounds += 1
        self._seen += n
        return np.stack([episode.returns[0] for episode in episodes])

    def _random(self, before: NDArray[Any] | None) -> NDArray[Any]:
        """Random actions (N, 1) or (N, 1, k), some of which persist from ``before``."""
        n, k = self.env.num_envs, self.env.actions
        if self.env.continuous:
            actions = 2.0 * torch.rand(n, 1, k, generator=self._draws).numpy() - 1.0
        else:
            actions = torch.randint(k, (n, 1), generator=self._draws).numpy()
        if before is not None:
            persist = torch.rand(n, generator=self._draws).numpy() < self.config.persistence
            actions[persist] = before[persist]
        return actions

    def _learn(self) -> torch.Tensor:
        """One gradient step on a batch of the store; the loss."""
        observations, actions, returns, left = self.store.sample(self.config.batch_size, self._draws)
        outputs = self._outputs(observations, returns, left)
        targets = torch.from_numpy(actions).to(self.device)
        loss = (
            nn.functional.mse_loss(outputs, targets)
            if self.env.continuous
            else nn.functional.cross_entropy(outputs, targets)
        )
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return loss.detach()

    # ------------------------------------------------------------------------------------------------------- measuring

    def _training_metrics(self) -> dict[str, float]:
        """Means over the exploring episodes since the last line of the log."""
        if not self._unlogged:
            return {}
        success, length, *returns = np.mean(self._unlogged, axis=0).tolist()
        self._unlogged = []
        named = {f"train/return/{name}": value for name, value in zip(self.env.objectives, returns, strict=True)}
        return {"train/success": success, "train/length": length, **named}

    def _forget(self) -> None:
        self._unlogged.clear()

    def evaluate_policies(
        self, conditions: ArrayLike, env: VectorEnv, *, episodes: int, seed: int, gamma: float
    ) -> list[Evaluation]:
        """Episodes of the greedy policy under each of ``conditions`` (K, d + 1), all on the same seeds.

        Args:
            conditions: desired discounted returns and horizons.
            env, episodes, seed, gamma: as for :meth:`front`.
        """
        rows = np.asarray(conditions, dtype=np.float32)
        return evaluate_each(
            lambda chosen: CommandPolicy(self, rows[chosen, :-1], rows[chosen, -1]),
            len(rows),
            env,
            episodes=episodes,
            seed=seed,
            gamma=gamma,
        )

    def front(self, env: VectorEnv, *, episodes: int, seed: int, gamma: float) -> Front:
        """The front, as greedy policies under :meth:`commands` show it when they are evaluated anew.

        Args:
            env: a raw environment, from `algorithms.common.env_adapter.make_env`; not the one that trains.
            episodes: of every policy; one is enough where every episode is the same.
            seed: of the first.
            gamma: discount of the returns that dominance goes by.
        """
        conditions = np.column_stack(self.commands())
        evaluations = self.evaluate_policies(conditions, env, episodes=episodes, seed=seed, gamma=gamma)
        names = (*self.env.objectives, HORIZON)
        return Front.of_evaluations(evaluations, conditions, names, gamma=gamma, seed=seed).non_dominated()

    def _evaluate(self, plan: EvaluationPlan) -> tuple[dict[str, float], Front]:
        front = self.front(plan.env, episodes=plan.episodes, seed=plan.seed, gamma=plan.gamma)
        found = indicators(
            front.discounted,
            reference_point=plan.reference_point,
            reference_front=plan.reference_front,
            scales=self.env.objective_scales,
        )
        found |= {f"return/{name}": float(front.returns[:, i].max()) for i, name in enumerate(front.objectives)}
        if np.isfinite(front.success).all():
            found["success"] = float(front.success.mean())
        return {f"eval/front/{name}": value for name, value in found.items()}, front

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def _identity(self) -> dict[str, Any]:
        # Under other scales or another discount the same numbers are other commands.
        return {**super()._identity(), "command_scales": self._command_scales.tolist(), "gamma": self.gamma}

    def _get_state(self) -> dict[str, torch.Tensor]:
        state = {
            "generator": self.generator.get_state(),
            "draws": self._draws.get_state(),
            "counts": torch.tensor([self._rounds, self._seen, self._worlds_seed]),
            **self._obedience(),
        }
        if self._unlogged:
            state["unlogged"] = torch.from_numpy(np.stack(self._unlogged))
        state |= {f"optimiser.{name}": tensor for name, tensor in optimiser_state(self.optimiser).items()}
        return state | {f"store.{name}": tensor for name, tensor in self.store.get_state().items()}

    def _obedience(self) -> dict[str, torch.Tensor]:
        """What acting under a command needs."""
        network = {f"network.{name}": tensor for name, tensor in self.network.state_dict().items()}
        return {"bounds": torch.from_numpy(np.stack(self.bounds)), **network}

    def _get_policy(self) -> dict[str, torch.Tensor]:
        # Of the store's episodes, which take megabytes, only what the commands are made of.
        returns, lengths = self._best()
        attained = {"returns": torch.from_numpy(returns.astype(np.float32)), "lengths": torch.from_numpy(lengths)}
        return {**self._obedience(), **{f"attained.{name}": tensor for name, tensor in attained.items()}}

    def _shapes(self, policy_only: bool) -> dict[str, tuple[int, ...]]:
        names = ("network.", "bounds") if policy_only else ("network.", "bounds", "generator", "draws", "counts")
        return {name: tuple(t.shape) for name, t in self._get_state().items() if name.startswith(names)}

    def _set_policy(self, tensors: dict[str, torch.Tensor]) -> None:
        attained = below(tensors, "attained.")
        self._attained = self._read_attained(attained) if attained else None
        self.network.load_state_dict(below(tensors, "network."))
        low, high = tensors["bounds"].numpy()
        self.bounds = low, high
        self.store.set_state(below(tensors, "store."))

    def _read_attained(self, state: dict[str, torch.Tensor]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Discounted returns (K, d) and decisions (K,) of the best episodes, as :meth:`_get_policy` wrote them.

        Raises:
            ValueError: if a part is missing or of another shape.
        """
        shapes = {name: tuple(state[name].shape) for name in ("returns", "lengths") if name in state}
        count = shapes.get("returns", (0,))[0]
        if not count or shapes != {"returns": (count, len(self.scales)), "lengths": (count,)}:
            raise ValueError(f"the best episodes of the policy are broken: {shapes}, for {len(self.scales)} objectives")
        return state["returns"].numpy().astype(np.float64), state["lengths"].numpy().astype(np.int64)

    def _set_state(self, tensors: dict[str, torch.Tensor]) -> None:
        self._set_policy(tensors)
        self._rounds, self._seen, self._worlds_seed = tensors["counts"].tolist()
        set_optimiser_state(self.optimiser, below(tensors, "optimiser."))
        self.generator.set_state(tensors["generator"])
        self._draws.set_state(tensors["draws"])
        self._unlogged = list(tensors["unlogged"].numpy()) if "unlogged" in tensors else []
