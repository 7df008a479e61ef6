"""What A2C, MO-A2C, PPO, MO-PPO, MOCAC and MAPPO share apart from the algorithm: collecting, acting, checkpoints.

An :class:`ActorCritic` has one :class:`Learner` per vehicle, or one for all of them. All learners act on one rollout,
and each then learns from its own vehicles' part of it. Vehicles that do not learn are driven by partners, and guides
may begin the episodes of those that do; the weights of both are no part of the agent. The file of an algorithm defines
its Learner, from the networks to the update.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from algorithms.agent import SHUFFLES, Agent
from algorithms.files.checkpoints import (
    ACCRUED_GAMMA,
    GUIDES,
    OBJECTIVE_SCALES,
    PARTNERS,
    strip_prefix,
)
from algorithms.hyperparameters import schedules
from algorithms.networks.modules import centralised_inputs
from algorithms.networks.optimiser import geometric_schedule, linear_schedule
from algorithms.networks.trained import TrainedNetworks, learners_identity
from algorithms.rollouts.advantages import next_values
from algorithms.rollouts.collector import Collector
from algorithms.rollouts.compiled_collection import CompiledCollection
from algorithms.rollouts.guides import Guides
from mo_deepdrive.evaluation.accrued_reward import AccruedReward
from mo_deepdrive.evaluation.metrics import ENTROPY_COEFFICIENT, LEARNING_RATE, vehicle_name
from mo_deepdrive.evaluation.policy import check_same_task

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from gymnasium.vector import VectorEnv
    from numpy.typing import NDArray

    from algorithms.rollouts.buffers import Episodes, Rollout, VehicleRollout
    from algorithms.rollouts.guides import Guide
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.evaluation.episodes import UtilityLike
    from mo_deepdrive.evaluation.team import Population
    from mo_deepdrive.utilities import Utility


class Learner(TrainedNetworks, ABC):
    """One policy's networks and how they learn; subclasses build the networks and define their inputs.

    Args:
        env: where the vehicles drive.
        vehicles: the indices of those with this policy, each of which is to a learner as if in an environment alone.
        utility: what they maximise.
        config: hyperparameters.
        generator: draws the initial weights.
        device: of the networks.

    Attributes:
        static_shapes: whether tensors have the same shape in every update, as on a device; else only what is needed is
            calculated.
        input_size: width of what the actor sees.
        others_size: width of what a centralised critic sees of the other vehicles; 0 without one.
        observes_accrued, observes_discount: whether the actor sees R_t and g^t.
        observation_scales, objective_scales: (o,) and (d,) nominal magnitudes.
        value_scales: (K,) by which the critic's outputs are multiplied.

    Raises:
        ValueError: for hyperparameters that do not fit the environment.
    """

    static_shapes = False
    input_size: int
    value_scales: torch.Tensor
    observes_accrued = False
    observes_discount = False

    def __init__(
        self,
        env: EnvAdapter,
        vehicles: tuple[int, ...],
        utility: Utility,
        config: Any,
        generator: torch.Generator,
        device: torch.device,
    ):
        del generator  # for the networks of the subclass
        self.vehicles = vehicles
        self.utility = utility
        self.config = config
        self.device = device
        self.observation_scales = torch.tensor(env.observation_scales, device=device)
        self.objective_scales = torch.tensor(env.chosen_objective_scales(config.objective_scales), device=device)
        if config.centralised_critic and env.vehicles == 1:
            raise ValueError("centralised_critic = True needs an environment with more than one vehicle")
        self.accrued_discount = float(getattr(config, "accrued_discount", config.gamma))
        self.others_size = (env.vehicles - 1) * env.observation_size if config.centralised_critic else 0

    def inputs(self, observations: torch.Tensor, accrued: torch.Tensor, discounts: torch.Tensor) -> torch.Tensor:
        """What the actor sees, scaled, (..., input_size): s_t, and R_t and g^t where the learner observes them.

        Args:
            observations: (..., o) s_t.
            accrued: (..., d) accrued reward R_t.
            discounts: (...) discount g^t that belongs to it.
        """
        parts = [observations / self.observation_scales]
        if self.observes_accrued:
            parts.append(accrued / self.objective_scales)
        if self.observes_discount:
            parts.append(discounts.unsqueeze(-1))
        return torch.cat(parts, dim=-1)

    def critic_inputs(self, inputs: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        """What the critic sees: ``inputs``, and with a centralised critic the other vehicles' observations."""
        return centralised_inputs(inputs, others, self.observation_scales) if self.others_size else inputs

    def values(self, critic_inputs: torch.Tensor) -> torch.Tensor:
        """v(S) (..., K) in the units of what the critic predicts."""
        outputs: torch.Tensor = self.critic(critic_inputs)
        return self.value_scales * outputs

    def next_values(self, rollout: VehicleRollout, values: torch.Tensor) -> torch.Tensor:
        """v(S_{t+1}) (T, N, K): 0 after termination, the value of the true final state after truncation.

        Args:
            rollout: T steps of its vehicles.
            values: (T + 1, N, K) v of S_0 to S_T.
        """
        return next_values(values[1:], self.final_values(rollout), rollout.terminated, rollout.truncated)

    def final_values(self, rollout: VehicleRollout) -> torch.Tensor:
        """V (T, N, K) of the true states after steps that truncated an episode; anything after other steps."""

        def values(where: torch.Tensor | slice) -> torch.Tensor:
            final = self.inputs(*rollout.final_states(where, self.accrued_discount))
            return self.values(self.critic_inputs(final, rollout.final_others[where]))

        if self.static_shapes:
            return values(slice(None))
        found = torch.zeros((*rollout.truncated.shape, len(self.value_scales)), device=self.device)
        if rollout.truncated.any():
            found[rollout.truncated] = values(rollout.truncated)
        return found

    @abstractmethod
    def update(
        self, rollout: VehicleRollout, learning_rate: float, entropy_coefficient: float, generator: torch.Generator
    ) -> dict[str, float]:
        """Learn from a rollout of its vehicles; the losses by name.

        Args:
            rollout: T steps of N environments, or of N k with k vehicles.
            learning_rate: of the gradient steps.
            entropy_coefficient: c_e.
            generator: of this update.
        """

    def on_episodes_end(self, discounted_returns: NDArray[np.float64]) -> None:
        """Called before an update with the discounted returns (E, d) of the episodes that ended; ignored by default."""
        del discounted_returns


class ActorCritic(Agent):
    """Base of the actor-critic agents: one independent learner per vehicle, or a policy that vehicles share.

    Args:
        env: a vector environment with vector rewards, from `mo_deepdrive.evaluation.env_adapter.make_env`.
        utility: the known utility, its name or a function of returns (..., d), or a list with one per vehicle.
        partners: what drives the vehicles that do not learn, by their indices.
        guides: what begins episodes of vehicles that learn.
        share_policy: one policy, learnt from what all vehicles do, instead of one for each that learns.
        **options: ``seed``, ``device`` and the hyperparameters, as of :class:`algorithms.agent.Agent`.

    Attributes:
        learners: one per vehicle that learns, in the order of the vehicles; or a single one.

    Raises:
        ValueError: for unknown or invalid hyperparameters, spaces or utilities, partners and guides that cannot drive
            here, or a policy that cannot be shared.
    """

    learner: ClassVar[type[Learner]]
    trains_with_partners = True
    trains_with_guides = True
    shares_policies = True

    def __init__(
        self,
        env: VectorEnv,
        utility: UtilityLike | Sequence[UtilityLike],
        *,
        partners: Mapping[int, Population] | None = None,
        guides: Sequence[Guide] = (),
        share_policy: bool = False,
        **options: Any,
    ):
        super().__init__(env, utility, **options)
        self.partners = dict(partners or {})
        if guides and not self.trains_with_guides:
            raise ValueError(f"algorithm {self.name!r} cannot train with guides")
        self.guides = Guides(guides, self.accrued_discount)
        for driver in (*self.partners.values(), *(guide.driver for guide in self.guides)):
            check_same_task(driver.members[0].env, self.env)
        for guide in self.guides:
            if guide.vehicle in self.partners:
                vehicle = vehicle_name(guide.vehicle)
                raise ValueError(f"{vehicle} has a guide, but does not learn: partners drive it")
        self.learners = [
            self.learner(self.env, vehicles, self.utilities[vehicles[0]], self.config, self.initial, self.device)
            for vehicles in self.vehicle_groups(share_policy, self.partners)
        ]
        self.collector = Collector(self.env, self.gamma, self.config.steps)
        self._compiled: CompiledCollection | None = None
        if self.config.cost_growth and any(guide.driver.observes_accrued_reward for guide in self.guides):
            raise ValueError(
                f"cost_growth = {self.config.cost_growth} must be 0 with a guide that observes the accrued reward, in "
                "which costs would be missing; take a guide that does not observe it, such as a rule"
            )
        if self.config.cost_growth and not self.env.costs.any():
            raise ValueError(
                f"cost_growth = {self.config.cost_growth} must be 0 in {self.env.name}: none of its objectives "
                f"{self.env.objectives} is known to be a cost"
            )

    @property
    def gamma(self) -> float | NDArray[np.float32]:
        """Discount of the accrued rewards that :meth:`act` is given: one number, or with partners one per vehicle."""
        if not self.partners:
            return self.accrued_discount
        discounts = np.full(self.env.vehicles, self.accrued_discount, dtype=np.float32)
        for v, partner in self.partners.items():
            discounts[v] = partner.gamma
        return discounts

    @property
    def schedules(self) -> list[str]:
        """Those of learning rate, entropy and costs, and guides, which withdraw."""
        return [*schedules(self.config), *self.guides.schedules]

    @property
    def observes_accrued_reward(self) -> bool:
        """Whether an actor sees R_t or g^t."""
        return any(learner.observes_accrued or learner.observes_discount for learner in self.learners)

    # --------------------------------------------------------------------------------------------- acting and learning

    @torch.inference_mode()
    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o); greedy where ``generator`` is None."""
        chosen = {v: each.act(observations, accrued_reward, generator) for v, each in self.partners.items()}
        for learner in self.learners:
            arrays = (observations, accrued_reward.value, accrued_reward.discounts)
            x = learner.inputs(*(learner.rows(array).to(self.device) for array in arrays))
            chosen |= learner.choose(x, generator)
        return chosen[0][:, None] if len(chosen) == 1 else np.stack([chosen[v] for v in sorted(chosen)], axis=1)

    def eval(self, obs: NDArray[Any], accrued_reward: NDArray[Any] | None = None, discount: float = 1.0) -> Any:
        """The greedy action for one observation, as in morl-baselines.

        Args:
            obs: as one environment gives it; (V, o) with several vehicles.
            accrued_reward: (d,) or (V, d) discounted sum of the episode's rewards so far; zeros if None.
            discount: gamma^t.

        Returns:
            An action as the environment takes it; one per vehicle with several.
        """
        so_far = AccruedReward.begin(1, self.env.vehicles, len(self.env.objectives))
        if accrued_reward is not None:
            so_far.value[:] = np.reshape(accrued_reward, so_far.value.shape)
        so_far.discounts[:] = discount
        observations = self.env.policy_observations(np.asarray(obs)[None]).astype(np.float32)
        return self.env.environment_actions(self.act(observations, so_far, None))[0]

    def _explore(self, observations: NDArray[np.float32], accrued_reward: AccruedReward) -> NDArray[Any]:
        actions = self.act(observations, accrued_reward, self.generator)
        return self.guides.drive(actions, observations, accrued_reward, self.generator)

    def begin(self) -> None:
        """Reset the environments."""
        self.collector.reset(self.env_seed)

    def update(self, progress: float) -> dict[str, float]:
        """Collect one rollout; each learner learns from its vehicles' part."""
        config = self.config
        self.collector.buffers.shares[:] = self.reward_shares(progress)
        rollout, episodes = self._collect(progress)
        self.episodes.append(episodes)
        self.step += config.steps * self.env.num_envs
        self.updates += 1

        learning_rate = linear_schedule(config.learning_rate, config.learning_rate_end, progress)
        entropy_coefficient = geometric_schedule(
            config.entropy_start, config.entropy_end, progress / config.entropy_until
        )
        for learner in self.learners:
            learner.on_episodes_end(episodes.discounted[np.isin(episodes.vehicles, learner.vehicles)])
        losses = self.learn(rollout, learning_rate, entropy_coefficient)
        return {LEARNING_RATE: learning_rate, ENTROPY_COEFFICIENT: entropy_coefficient, **losses}

    def _collect(self, progress: float) -> tuple[Rollout, Episodes]:
        """A rollout; if nothing but our compiled code acts, in one compiled call, with the same bits."""
        if self._compiled is None and self._can_be_compiled():
            self._compiled = CompiledCollection(
                self.collector,
                {learner.vehicles: learner.actor for learner in self.learners},
                self.learners[0].objective_scales.numpy() if self.learners[0].observes_accrued else None,
            )
        if self._compiled is not None:
            self._compiled.collect(self.generator)
            return self.collector.collected()
        self.guides.begin_rollout(progress)
        rollout, episodes = self.collector.collect(self._explore)
        self.guides.hide(rollout)
        return rollout, episodes

    def _can_be_compiled(self) -> bool:
        """Whether the learners alone act, as this class and Learner define it."""
        own = type(self).act is ActorCritic.act and type(self)._explore is ActorCritic._explore
        alone = not self.partners and not any(self.guides)
        usual = all(map(self._sees_what_is_usual, self.learners))
        actors = [learner.actor for learner in self.learners]
        return own and alone and usual and CompiledCollection.serves(self.collector, actors)

    def _sees_what_is_usual(self, learner: Learner) -> bool:
        """Whether a learner's actor sees what Learner defines, in the scales that all learners share."""
        scales = np.array_equal(learner.observation_scales.cpu().numpy(), self.env.observation_scales)
        units = torch.equal(learner.objective_scales, self.learners[0].objective_scales)
        return type(learner).inputs is Learner.inputs and scales and units

    def reward_shares(self, progress: float) -> NDArray[np.float32]:
        """By what rewards are multiplied, (V, d): 1, and less for costs while these grow."""
        shares = np.ones((self.env.vehicles, len(self.env.objectives)), dtype=np.float32)
        if progress < self.config.cost_growth:
            for learner in self.learners:
                for v in learner.vehicles:
                    shares[v, self.env.costs] = progress / self.config.cost_growth
        return shares

    def learn(self, rollout: Rollout, learning_rate: float, entropy_coefficient: float) -> dict[str, float]:
        """Each learner learns from its vehicles' part of a rollout; the losses by name."""
        metrics: dict[str, float] = {}
        for learner in self.learners:
            own = rollout.of_vehicles(learner.vehicles, self.device, others=learner.others_size > 0)
            generator = self.update_generator(SHUFFLES + learner.vehicle)
            losses = learner.update(own, learning_rate, entropy_coefficient, generator)
            prefix = learner.metric_prefix(self.env.vehicles)
            metrics |= {prefix + name: value for name, value in losses.items()}
        return metrics

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must share with the agent that reads it."""
        drivers = {vehicle_name(v): list(partner.digests) for v, partner in self.partners.items()}
        return {
            **super().identity(),
            **self.config.identity(continuous=self.env.continuous),
            "centralised_critic": self.config.centralised_critic,
            "inputs": self.learners[0].input_size,
            **self._units(),
            **learners_identity(self.learners),
            PARTNERS: drivers,
            GUIDES: self.guides.identity(),
        }

    def _units(self) -> dict[str, Any]:
        """What the learners observe the accrued reward in units of."""
        learner = self.learners[0]
        units: dict[str, Any] = {}
        if learner.observes_accrued:
            units[OBJECTIVE_SCALES] = learner.objective_scales.tolist()
        if learner.observes_accrued or learner.observes_discount:
            units[ACCRUED_GAMMA] = self.accrued_discount
        return units

    def get_state(self) -> dict[str, torch.Tensor]:
        """Learners, guides, environments and running episodes."""
        state: dict[str, torch.Tensor] = {}
        for learner in self.learners:
            state |= {f"{learner.name}.{name}": tensor for name, tensor in learner.get_state().items()}
        state |= self.guides.get_state()
        state |= {f"collector.{name}": tensor for name, tensor in self.collector.tensors().items()}
        return state

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`.

        Raises:
            ValueError: for values from which training cannot continue.
        """
        for learner in self.learners:
            learner.set_state(strip_prefix(state, f"{learner.name}."))
        self.guides.set_state(state)
        self.updates = self.collector.resume(strip_prefix(state, "collector."), self.step, self.env_seed)

    def get_policy(self) -> dict[str, torch.Tensor]:
        """The actors' weights."""
        return {
            f"{learner.name}.{name}": tensor
            for learner in self.learners
            for name, tensor in learner.get_policy().items()
        }

    def set_policy(self, state: dict[str, torch.Tensor]) -> None:
        """Take the actors' weights."""
        for learner in self.learners:
            learner.set_policy(strip_prefix(state, f"{learner.name}."))
