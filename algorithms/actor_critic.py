"""The update of A2C, MO-A2C, PPO, MO-PPO, rulebook PPO, MOCAC, MAPPO and conditioned MO-PPO, but for their equations.

An :class:`ActorCritic` has one policy per vehicle, or one for all of them, and every algorithm has the same update:

    collect     T steps of N environments, in which all policies act;
    values      v(S_t) and v(S_{t+1}) of the critic as it is;
    advantages  A_t and the critic's targets y_t, by the equations in the algorithm's file;
    minibatches of all samples, in a new order every epoch;
    loss        L, by the equations in the algorithm's file;
    step        of Adam, down the gradient of L.

The file of an algorithm defines ``Config``, :meth:`ActorCritic.advantages` and :meth:`ActorCritic.loss`. Both are pure
functions of tensors, so that the same lines run for one seed and for several side by side (``torch.func.vmap``), as
they are and through ``torch.compile``, on a CPU and, as one CUDA graph an update, on a GPU.

Vehicles that do not learn are driven by partners, and guides may begin the episodes of those that do; the weights of
both are no part of the agent.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from dataclasses import fields
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from algorithms.agent import ACTIONS, LEARNING, Agent
from algorithms.hyperparameters import geometric_schedule, linear_schedule, schedules
from algorithms.learning.actors import check_outputs, make_actor
from algorithms.learning.advantages import bootstrapped, normalise
from algorithms.learning.checkpoints import GUIDES, PARTNERS, strip_prefix
from algorithms.learning.collector import Collector, DeviceWorlds, EnvWorlds
from algorithms.learning.compiling import pure
from algorithms.learning.guides import check_guides
from algorithms.learning.learner import NORM, Learner, Networks
from algorithms.learning.networks import make_network
from algorithms.learning.storage import Rollout, Samples
from mo_deepdrive.evaluation.metrics import ENTROPY_COEFFICIENT, LEARNING_RATE, vehicle_name, vehicle_prefix
from mo_deepdrive.evaluation.policy import AccruedReward, check_same_task
from mo_deepdrive.support.faults import NotFinite

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from gymnasium.vector import VectorEnv
    from numpy.typing import NDArray
    from typing_extensions import Self

    from algorithms.learning.actors import Actor
    from algorithms.learning.collector import Running
    from algorithms.learning.guides import Guide
    from algorithms.learning.losses import Loss
    from algorithms.learning.preferences import TrainingPreferences
    from algorithms.learning.storage import RolloutStorage
    from mo_deepdrive.evaluation.episodes import UtilityLike
    from mo_deepdrive.evaluation.team import Population
    from mo_deepdrive.utilities import Utility

MEMORY = 0.99  # decay per episode of the running mean of returns
WARM_UP = 2  # updates before one is captured: what is compiled or allocated once must not be part of it


class PolicyLearner(Learner):
    """The learner of one policy, an actor and a critic, for S seeds.

    Each of the ``vehicles`` with this policy is to it as if in an environment alone.
    """

    noise: Tensor  # (S, T, N, k, n) random numbers of the actions of a rollout
    order: Tensor  # (S, epochs, T N k) in which an epoch takes the samples; no epochs where it takes all at once
    prepare: Callable[..., dict[str, Tensor]]  # makes samples of a rollout

    def __init__(self, networks: Sequence[Networks], max_grad_norm: float, vehicles: tuple[int, ...], objectives: int):
        # ``vehicle_0``, or ``vehicles`` of several that share it.
        super().__init__(networks, max_grad_norm, vehicle_name(vehicles[0]) if len(vehicles) == 1 else "vehicles")
        self.vehicles = vehicles
        # (S, d) E[R], running mean of the accrued rewards of episodes, and (S,) their number.
        self.expected_return = self.vector.new_zeros(self.seeds, objectives)
        self.episodes = torch.zeros(self.seeds, dtype=torch.int64, device=self.vector.device)
        self.actor: Actor = self.networks.actor  # of the first seed
        self.critic: torch.nn.Module = self.networks.critic

    def update_on_episode_end(self, values: Tensor, ended: Tensor) -> None:
        """Update E[R] with the accrued rewards (S, T, N k, d) of the episodes that ended, where a mask says."""
        number = ended.sum((1, 2))
        mean = values.masked_fill(~ended.unsqueeze(-1), 0.0).sum((1, 2)) / number.clamp(min=1).unsqueeze(-1)
        keep = torch.where(self.episodes > 0, MEMORY**number, (number == 0).float()).unsqueeze(-1)
        self.expected_return.copy_(keep * self.expected_return + (1.0 - keep) * mean)
        self.episodes.add_(number)

    def get_state(self, seed: int = 0) -> dict[str, Tensor]:
        """Networks, optimiser and E[R]."""
        own = {"expected_return": self.expected_return[seed], "episodes": self.episodes[seed]}
        return {**super().get_state(seed), **own}

    def set_state(self, state: Mapping[str, Tensor], seed: int = 0) -> None:
        """Resume from :meth:`get_state`."""
        super().set_state(state, seed)
        self.expected_return[seed], self.episodes[seed] = state["expected_return"], state["episodes"]


class ActorCritic(Agent):
    """Base of the actor-critic agents: one policy per vehicle that learns, or one that vehicles share.

    A subclass defines ``Config``, :meth:`advantages` and :meth:`loss`, and may define what the networks see:
    :attr:`input_size` and :meth:`inputs`, :attr:`state_size` and :meth:`states`, :attr:`value_scales`.

    Args:
        env: as of :class:`algorithms.agent.Agent`.
        utility: likewise.
        partners: what drives the vehicles that do not learn, by their indices.
        guides: what begins episodes of vehicles that learn.
        share_policy: one policy, learnt from what all vehicles do, instead of one for each that learns.
        **options: ``seed``, ``device``, ``compiled`` and the hyperparameters, likewise.

    Attributes:
        samples_class: what :meth:`samples` gives and :meth:`loss` takes.
        judged: what the utility is of, "rewards" or "ended_values".
        compares_policies: whether the loss needs the log-probability under the policy that collected the rollout.
        observes_accrued, observes_discount: whether actors see R_t and g^t.
        learners: one per vehicle that learns, in the order of the vehicles; or a single one.

    Raises:
        ValueError: as there, for partners and guides that cannot drive here, or a policy that cannot be shared.
    """

    samples_class: ClassVar[type[Any]] = Samples
    trains_with_partners = True
    trains_with_guides = True
    shares_policies = True
    trains_on_devices = True
    judged: ClassVar[str] = "ended_values"
    compares_policies: ClassVar[bool] = True
    observes_accrued: bool = False
    observes_discount: bool = False

    def __init__(
        self,
        env: VectorEnv,
        utility: UtilityLike | Sequence[UtilityLike] | None = None,
        *,
        partners: Mapping[int, Population] | None = None,
        guides: Sequence[Guide] = (),
        share_policy: bool = False,
        **options: Any,
    ):
        super().__init__(env, utility, **options)
        config = self.config
        self.partners, self.guides = dict(partners or {}), tuple(guides)
        self._driving = [torch.Generator(self.device) for _ in self.seeds]  # of partners' and guides' random numbers
        self._check_drivers()
        if config.centralised_critic and self.env.vehicles == 1:
            raise ValueError("centralised_critic = True needs an environment with more than one vehicle")
        if config.cost_growth and self.known_utility and not self.env.costs.any():
            raise ValueError(
                f"cost_growth = {config.cost_growth} must be 0 in {self.env.name}: none of its objectives "
                f"{self.env.objectives} is known to be a cost"
            )
        self.share_policy = share_policy
        self.scales = self.env.chosen_objective_scales(config.objective_scales)
        self.observation_scales = torch.tensor(self.env.observation_scales, device=self.device)
        self.objective_scales = torch.tensor(self.scales, device=self.device)
        self._costs = torch.from_numpy(self.env.costs).to(self.device)
        self.prepare()
        generators = [self.initial_generator(index) for index in range(len(self.seeds))]
        self.learners = [
            PolicyLearner(
                [self.make_networks(generator).to(self.device) for generator in generators],
                config.max_grad_norm,
                vehicles,
                len(self.env.objectives),
            )
            for vehicles in self.vehicle_groups(share_policy, self.partners)
        ]
        self.preferences_now: TrainingPreferences | None = None
        self._collector: Collector | None = None
        self._learning_rate, self._entropy_coefficient = torch.zeros(2, device=self.device)
        self._graph: Any = None
        self._warmed_up = 0  # updates in this process
        self._losses: dict[str, Tensor] = {}
        self._problems: dict[int, str] = {}  # of the worlds, by the index of the seed

    def prepare(self) -> None:
        """Called before networks are made; a subclass may prepare here what they depend on."""

    def _check_drivers(self) -> None:
        if self.guides and not self.trains_with_guides:
            raise ValueError(f"algorithm {self.name!r} cannot train with guides")
        check_guides(self.guides, self.accrued_discount)
        for driver in (*self.partners.values(), *(guide.driver for guide in self.guides)):
            check_same_task(driver.members[0].env, self.env)
        if both := [vehicle_name(guide.vehicle) for guide in self.guides if guide.vehicle in self.partners]:
            raise ValueError(f"{both[0]} has a guide, but does not learn: partners drive it")
        growth = self.config.cost_growth
        if growth and self.known_utility and any(guide.driver.observes_accrued_reward for guide in self.guides):
            raise ValueError(
                f"cost_growth = {growth} must be 0 with a guide that observes the accrued reward, in "
                "which costs would be missing; take a guide that does not observe it, such as a rule"
            )

    # -------------------------------------------------------------------------------------------- what an algorithm is

    @abstractmethod
    def advantages(self, rollout: Rollout, values: Tensor, next_values: Tensor) -> tuple[Tensor, Tensor]:
        """A_t (T, N) and the critic's targets y_t (T, N, K), a pure function of tensors, for one seed.

        Args:
            rollout: T steps of N environments.
            values: (T, N, K) v(S_t).
            next_values: (T, N, K) v(S_{t+1}): 0 after termination, that of the true final state after truncation.
        """

    @abstractmethod
    def loss(self, networks: Networks, samples: Any, entropy_coefficient: Tensor) -> Loss:
        """The loss of one seed's samples, a pure function of tensors; ``networks`` has an actor and a critic."""

    @property
    def input_size(self) -> int:
        """Width of what an actor sees."""
        return self.env.observation_size + len(self.env.objectives) * self.observes_accrued + self.observes_discount

    def inputs(self, observations: Tensor, accrued: Tensor, discounts: Tensor, preference: Any = None) -> Tensor:
        """What an actor sees, scaled, (..., input_size): s_t, and R_t and g^t where it observes them."""
        del preference
        seen = observations / self.observation_scales
        past = [accrued / self.objective_scales] if self.observes_accrued else []
        past += [discounts.unsqueeze(-1)] if self.observes_discount else []
        return torch.cat([seen, *past], dim=-1) if past else seen

    @property
    def state_size(self) -> int:
        """Width of what a critic sees."""
        others = (self.env.vehicles - 1) * self.env.observation_size if self.config.centralised_critic else 0
        return self.input_size + others

    def states(self, storage: RolloutStorage, vehicles: tuple[int, ...]) -> dict[str, Tensor]:
        """What the critic of some vehicles sees, where that is not what the actor sees.

        That is ``states`` (S, T + 1, N k, c) before each step and ``final_states`` (S, T, N k, c) after it; with a
        centralised critic what the actor sees, and what the other vehicles observe.
        """
        if not self.config.centralised_critic:
            return {}

        def seen(inputs: Tensor) -> Tensor:
            observed = inputs[..., : self.env.observation_size].unbind(3)
            others = [torch.cat([*observed[:v], *observed[v + 1 :]], dim=-1) for v in vehicles]
            return torch.cat([storage.of_vehicles(inputs, vehicles), torch.stack(others, dim=3).flatten(2, 3)], dim=-1)

        return {"states": seen(storage.inputs), "final_states": seen(storage.final_inputs)}

    @property
    def value_scales(self) -> Tensor:
        """(K,) by which the critic's outputs are multiplied."""
        return torch.full((1,), self.config.value_scale, device=self.device)

    def make_networks(self, generator: torch.Generator) -> Networks:
        """An actor and a critic."""
        config, env = self.config, self.env
        return Networks(
            actor=make_actor(config, self.input_size, env.actions, generator, continuous=env.continuous),
            critic=make_network(config, self.state_size, len(self.value_scales), generator),
        )

    def diagnose(self, learner: PolicyLearner, seed: int) -> None:
        """Raise a NotFinite that says why a loss of a seed is not finite, by checked calls of what may be the cause."""
        for v in learner.vehicles if self.utilities else ():
            self.utilities[v](getattr(self.collector.storage, self.judged)[seed, :, :, v])

    # ---------------------------------------------------------------------------------------------------------- acting

    @property
    def gamma(self) -> float | NDArray[np.float32]:
        """Discount of the accrued rewards that :meth:`act` is given: one number, or with partners one per vehicle."""
        if not self.partners:
            return self.accrued_discount
        drivers = [self.partners.get(v) for v in range(self.env.vehicles)]
        return np.array([each.gamma if each else self.accrued_discount for each in drivers], dtype=np.float32)

    @property
    def schedules(self) -> list[str]:
        """Those of learning rate, entropy and costs, and guides, which withdraw."""
        return schedules(self.config) + [
            f"training.guides.{vehicle_name(guide.vehicle)}.until = {guide.settings.until}" for guide in self.guides
        ]

    @property
    def observes_accrued_reward(self) -> bool:
        """Whether an actor sees R_t or g^t."""
        return bool(self.observes_accrued or self.observes_discount)

    @torch.inference_mode()
    def act(
        self,
        observations: NDArray[np.float32],
        accrued_reward: AccruedReward,
        generator: torch.Generator | None,
        preference: Any = None,
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o); greedy where ``generator`` is None."""
        chosen = {v: each.act(observations, accrued_reward, generator) for v, each in self.partners.items()}
        arrays = (observations, accrued_reward.value, accrued_reward.discounts)
        seen, accrued, discounts = (torch.from_numpy(each).to(self.device) for each in arrays)
        inputs = self.inputs(seen, accrued, discounts, preference)
        for learner in self.learners:
            actions = learner.actor.act(inputs[:, learner.vehicles], generator).cpu().numpy()
            chosen |= {v: actions[:, j] for j, v in enumerate(learner.vehicles)}
        if len(chosen) < self.env.vehicles:  # without partners
            idle = np.zeros_like(next(iter(chosen.values())))
            chosen = {v: chosen.get(v, idle) for v in range(self.env.vehicles)}
        return np.stack([chosen[v] for v in sorted(chosen)], axis=1)

    def without_partners(self) -> Self:
        """The same policies without partners, whose vehicles get actions of zeros: for others to drive these."""
        agent = copy.copy(self)
        agent.partners = {}
        return agent

    def eval(self, obs: NDArray[Any], accrued_reward: NDArray[Any] | None = None, discount: float = 1.0) -> Any:
        """The greedy action for one observation, as in morl-baselines; one per vehicle with several.

        The accrued reward (d,) or (V, d) is the discounted sum of the episode's rewards so far, the discount gamma^t.
        """
        so_far = AccruedReward.begin(1, self.env.vehicles, len(self.env.objectives))
        if accrued_reward is not None:
            so_far.value[:] = np.reshape(accrued_reward, so_far.value.shape)
        so_far.discounts[:] = discount
        observations = self.env.policy_observations(np.asarray(obs)[None]).astype(np.float32)
        return self.env.environment_actions(self.act(observations, so_far, None))[0]

    # ------------------------------------------------------------------------------------------------------ the update

    def begin(self) -> None:
        """Reset the environments."""
        self.collector.reset()
        for guide in self.guides:
            guide.repeat(len(self.seeds))

    def update(self, progress: float) -> dict[str, Any]:
        """Collect one rollout; each policy learns from its vehicles' part."""
        config = self.config
        learning_rate = linear_schedule(config.learning_rate, config.learning_rate_end, progress)
        entropy = geometric_schedule(config.entropy_start, config.entropy_end, progress / config.entropy_until)
        self._learning_rate.fill_(learning_rate)
        self._entropy_coefficient.fill_(entropy)
        grown = progress / config.cost_growth if progress < config.cost_growth else 1.0
        self.grow_costs(grown**config.cost_growth_power)
        for guide in self.guides:
            guide.begin_rollout(progress)
        for seed in range(len(self.seeds)):
            self._draw(seed)
        self._run()
        self.step += config.steps * self.env.num_envs
        self.updates += 1
        losses = {name: loss for name, loss in self._losses.items() if not name.endswith(NORM)}
        return {LEARNING_RATE: learning_rate, ENTROPY_COEFFICIENT: entropy, **losses}

    def grow_costs(self, share: float) -> None:
        """Multiply the costs among the rewards that are learnt from by a share."""
        for learner in self.learners:
            for v in learner.vehicles:
                self.collector.shares[v].fill_(1.0).masked_fill_(self._costs, share)

    def _draw(self, seed: int) -> None:
        """Draw the random numbers of an update of the seed with this index."""
        generator = torch.Generator(self.device)
        self._driving[seed].manual_seed(self.seed_of(ACTIONS, seed))
        for learner in self.learners:
            generator.manual_seed(self.seed_of(LEARNING + learner.vehicles[0], seed))
            learner.actor.draw(learner.noise[seed], generator)
            epochs, rows = learner.order.shape[1:]
            if self.device.type == "cpu":
                for epoch in range(epochs):
                    torch.randperm(rows, generator=generator, out=learner.order[seed, epoch])
            elif epochs:  # one launch for all
                keys = torch.rand(epochs, rows, generator=generator, device=self.device)
                learner.order[seed] = keys.argsort(dim=-1)

    def _run(self) -> None:
        """The part of an update that is the same every time; on a GPU one CUDA graph where only learners drive."""
        self._warmed_up += 1
        if self.device.type == "cpu" or self._warmed_up <= WARM_UP or self.partners or self.guides:
            self._collect_and_learn()
            return
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            torch.cuda.synchronize(self.device)
            with torch.cuda.device(self.device), torch.cuda.graph(self._graph):
                self._collect_and_learn()
        self._graph.replay()

    @torch.no_grad()
    def _collect_and_learn(self) -> None:
        storage = self.collector.storage
        self.collector.collect()
        self.before_learning(storage)
        for learner in self.learners:
            values = storage.of_vehicles(storage.ended_values, learner.vehicles)
            learner.update_on_episode_end(values, storage.of_vehicles(storage.ended, learner.vehicles))
            prefix = vehicle_prefix(learner.vehicles[0], self.env.vehicles) if len(learner.vehicles) == 1 else ""
            self._losses |= {prefix + name: loss for name, loss in self.learn_once(learner, storage).items()}
        if self.preferences_now is not None:
            self.preferences_now.update_on_episode_end(storage.ended_values, storage.ended)

    def before_learning(self, storage: RolloutStorage) -> None:
        """Called between collecting a rollout and learning from it."""

    def learn_once(self, learner: PolicyLearner, storage: RolloutStorage) -> dict[str, Tensor]:
        """Epochs of minibatch steps on a rollout; the means over them of the parts of the loss, (S,)."""
        rollout = self.rollout_of(learner, storage)
        with pure("an advantage", rollout):
            samples = learner.compute(learner.prepare, rollout)
        steps = [
            learner.minimise(self._loss, samples, rows, self._learning_rate, self._entropy_coefficient)
            for rows in self._minibatches(learner.order)
        ]
        return {name: torch.stack([step[name] for step in steps]).mean(0) for name in steps[0]}

    def rollout_of(self, learner: PolicyLearner, storage: RolloutStorage) -> dict[str, Tensor]:
        """The fields of :class:`Rollout` of a policy, with the axis of seeds.

        Without ``states`` and ``final_states`` those are ``inputs`` and ``final_inputs``.
        """
        vehicles, names = learner.vehicles, {"final_inputs", *(field.name for field in fields(Rollout))}
        return {
            **{name: storage.of_vehicles(each, vehicles) for name, each in vars(storage).items() if name in names},
            **self.states(storage, vehicles),
            "expected_return": learner.expected_return,
            "ideal": learner.expected_return if self.preferences_now is None else self.preferences_now.ideal,
        }

    def _samples(
        self, utility: Utility | None, always: bool, networks: Networks, tensors: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """What one seed learns from its rollout, (T N, ...), by the fields of Samples."""
        parts = {"states": tensors["inputs"], "final_states": tensors["final_inputs"], **tensors}
        del parts["final_inputs"]
        samples = self.samples(networks, Rollout(**parts, utility=utility))._asdict()
        if always:
            del samples["weights"]
        if "states" not in tensors:
            del samples["states"]
        return {name: each.flatten(0, 1) for name, each in samples.items() if each is not None}

    def samples(self, networks: Networks, rollout: Rollout) -> Any:
        """What one seed learns from its rollout, (T, N, ...): A_t, y_t and log pi_old of the networks as they are."""
        scales = self.value_scales
        values = scales * networks.critic(rollout.states)
        next_values = self.next_values(networks, rollout, values)
        advantages, targets = self.advantages(rollout, values[:-1], next_values)
        weights = rollout.acted.to(advantages.dtype)
        if self.config.normalise_advantages:
            advantages = normalise(advantages, weights)
        log_prob = networks.actor.evaluate(rollout.outputs, rollout.actions)[0] if self.compares_policies else None
        seen = rollout.inputs[:-1], rollout.states[:-1]
        return Samples(*seen, rollout.actions, advantages, targets / scales, log_prob, weights)

    def next_values(self, networks: Networks, rollout: Rollout, values: Tensor) -> Tensor:
        """v(S_{t+1}) (T, N, K) from v (T + 1, N, K) of S_0 to S_T and of the true final states."""
        final = values[1:]
        if self.collector.static:
            final = self.value_scales * networks.critic(rollout.final_states)
        elif rollout.truncated.any():
            final = final.clone()
            final[rollout.truncated] = self.value_scales * networks.critic(rollout.final_states[rollout.truncated])
        return bootstrapped(values[1:], final, rollout.terminated, rollout.truncated)

    def _loss(self, networks: Networks, tensors: dict[str, Tensor], entropy_coefficient: Tensor) -> Loss:
        return self.loss(networks, self.samples_class(**{"states": tensors["inputs"], **tensors}), entropy_coefficient)

    def _minibatches(self, order: Tensor) -> Iterator[list[Tensor]]:
        """The samples of every gradient step: [(S, m)] indices, or [] for all."""
        if order.shape[1] == 0:
            yield []
        for epoch in order.unbind(1):
            parts = min(self.config.minibatches, epoch.shape[-1])
            yield from ([rows.contiguous()] for rows in epoch.tensor_split(parts, dim=-1))

    # ------------------------------------------------------------------------------------------------------ collecting

    @property
    def collector(self) -> Collector:
        """What collects, made when it is first needed: an agent that only acts needs none."""
        if self._collector is None:
            config, env = self.config, self.env
            shape = seeds, steps, num_envs = len(self.seeds), config.steps, env.num_envs
            worlds: DeviceWorlds | EnvWorlds = (
                DeviceWorlds(env.vector_env.unwrapped.config, self.env_seeds, num_envs, self.device)  # type: ignore[attr-defined]
                if self.resident
                else EnvWorlds(env, self.env_seed)
            )
            self.preferences_now = self.training_preferences(shape)
            outputs = env.actions * (2 if env.continuous and config.state_dependent_std else 1)
            self._collector = Collector(
                self, env, worlds, shape, outputs, self.episodes, self.preferences_now, static=self.resident
            )
            self._collector.accrued_discounts[:] = torch.as_tensor(self.gamma, dtype=torch.float32)
            # Whether all samples count: no vehicle waits for another's end, and no guide drives.
            always = env.native and env.vehicles == 1 and not self.guides
            for learner in self.learners:
                k = len(learner.vehicles)
                utility = self.utilities[learner.vehicles[0]].unchecked() if self.utilities else None
                learner.prepare = partial(self._samples, utility, always)
                learner.noise = torch.zeros(*shape, k, learner.actor.noise, device=self.device)
                order = seeds, getattr(config, "epochs", 0), steps * num_envs * k
                learner.order = torch.zeros(order, dtype=torch.int64, device=self.device)
        return self._collector

    def training_preferences(self, shape: tuple[int, int, int]) -> TrainingPreferences | None:
        """Those under which S seeds act in T steps of N environments; None for no preferences."""
        del shape
        return None

    def decide(self, t: int, at: RolloutStorage, now: Running) -> None:
        """Write the actions of step t: those of all policies, then those of partners and guides."""
        for learner in self.learners:
            one = self.env.vehicles == 1
            seen = at.inputs if one else torch.stack([at.inputs[:, :, v] for v in learner.vehicles], dim=2)
            chosen, outputs = learner.compute(_choose, (seen, learner.noise[:, t]))
            for j, v in enumerate(learner.vehicles):
                at.actions[:, :, v], at.outputs[:, :, v] = chosen[:, :, j], outputs[:, :, j]
        if self.partners or self.guides:
            self._drive(at, now)

    def _drive(self, at: RolloutStorage, now: Running) -> None:
        """Let partners and guides drive, for whom observations and actions are arrays."""
        for seed, generator in enumerate(self._driving):
            observations, past = now.arrays(seed)
            taken = at.actions[seed].cpu().numpy()
            for v, partner in self.partners.items():
                taken[:, v] = partner.act(observations, past, generator)
            for guide in self.guides:
                led = guide.drive(taken, observations, past, generator, seed)
                at.led[seed, :, guide.vehicle] = torch.from_numpy(led).to(self.device)
            at.actions[seed] = torch.from_numpy(taken).to(self.device)

    def check(self, seed: int) -> None:
        """Refuse what the seed with this index has computed, if it is not finite, with its origin."""
        storage = self.collector.storage
        self.collector.check(seed)
        check_outputs(storage.outputs[seed].transpose(0, 1))
        self._problems |= self.collector.worlds.check()
        if seed in self._problems:
            raise NotFinite(self._problems[seed])
        for name, loss in self._losses.items():
            if not name.endswith(NORM) or loss[seed].isfinite():
                continue
            for learner in self.learners:
                self.diagnose(learner, seed)
            prefix = name.removesuffix(NORM)
            named = ", ".join(
                f"{part.removeprefix(prefix)} = {float(value[seed]):g}"
                for part, value in self._losses.items()
                if part.startswith(prefix) and part != name
            )
            raise NotFinite(f"{name} = {float(loss[seed])} in single precision ({named})")

    # ----------------------------------------------------------------------------------------------------------- seeds

    def gradient_steps(self, total_timesteps: int) -> int:
        """How many there are in a training."""
        updates = total_timesteps // (self.config.steps * self.env.num_envs)
        return int(updates * getattr(self.config, "epochs", 1) * getattr(self.config, "minibatches", 1))

    def of_seed(self, index: int) -> Any:
        """The agent of the seed with this index, on the CPU, with what it has learnt; itself if there is no other."""
        if not self.resident:
            return self
        utility = (self.utilities,) if self.known_utility else ()
        drivers: dict[str, Any] = {"partners": self.partners, "guides": self.guides, "share_policy": self.share_policy}
        agent = type(self)(self.env.vector_env, *utility, seed=self.seeds[index], config=self.config, **drivers)
        agent.step, agent.updates = self.step, self.updates
        agent.set_policy({name: each.cpu() for name, each in self.get_policy(index).items()})
        return agent

    def fail(self, seed: int, error: Any, when: str) -> None:
        """End a seed, whose networks go on with parameters that do no harm."""
        super().fail(seed, error, when)
        for learner in self.learners:
            learner.park(seed)

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must share with the agent that reads it."""
        return {
            **super().identity(),
            **self.config.identity(continuous=self.env.continuous),
            "centralised_critic": self.config.centralised_critic,
            "inputs": self.input_size,
            # What the policies observe the accrued reward in units of.
            **({"objective_scales": self.scales.tolist()} if self.observes_accrued else {}),
            **({"accrued_discount": self.accrued_discount} if self.observes_accrued_reward else {}),
            **({"share_policy": True} if self.share_policy else {}),
            PARTNERS: {vehicle_name(v): list(partner.digests) for v, partner in self.partners.items()},
            GUIDES: {vehicle_name(guide.vehicle): guide.identity for guide in self.guides},
        }

    @property
    def running(self) -> dict[str, Tensor]:
        """Tensors (S, ...) by name that continue from one rollout to the next, beside those of learners and worlds."""
        return {}

    def get_state(self) -> dict[str, Tensor]:
        """:meth:`get_seed_state` of the first seed."""
        return self.get_seed_state(0)

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Resume from :meth:`get_state`."""
        self.set_seed_states([state])

    def get_seed_state(self, seed: int) -> dict[str, Tensor]:
        """Learners, guides, worlds and running episodes of the seed with this index."""
        parts = {learner.name: learner.get_state(seed) for learner in self.learners}
        parts["collector"] = self.collector.get_state(seed)
        state = {f"{part}.{name}": tensor for part, tensors in parts.items() for name, tensor in tensors.items()}
        for guide in self.guides:
            state[f"guide_{guide.vehicle}.handover"] = torch.from_numpy(guide.handovers[seed])
        return state | {name: tensor[seed] for name, tensor in self.running.items()}

    def set_seed_states(self, states: Sequence[dict[str, Tensor]]) -> None:
        """Resume from :meth:`get_seed_state` of all seeds."""
        for guide in self.guides:
            guide.repeat(len(states))
        for seed, state in enumerate(states):
            for learner in self.learners:
                learner.set_state(strip_prefix(state, f"{learner.name}."), seed)
            for guide in self.guides:
                guide.handovers[seed][:] = state[f"guide_{guide.vehicle}.handover"].numpy()
            for name, tensor in self.running.items():
                tensor[seed] = state[name]
        self.collector.set_state([strip_prefix(state, "collector.") for state in states], self.step)

    def get_policy(self, seed: int = 0) -> dict[str, Tensor]:
        """The actors' weights."""
        return {
            f"{learner.name}.{name}": each
            for learner in self.learners
            for name, each in learner.get_weights("actor", seed).items()
        }

    def set_policy(self, state: dict[str, Tensor]) -> None:
        """Take the actors' weights."""
        for learner in self.learners:
            learner.set_weights(strip_prefix(state, f"{learner.name}."))


def _choose(networks: Networks, seen: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Actions (N, V) or (N, V, k) for inputs (N, V, i) and random numbers, and the outputs (N, V, n) of the network."""
    actor: Actor = networks.actor
    outputs = actor.body(seen[0])
    chosen = actor.choose(outputs, seen[1])
    # Worlds take no numbers that are not finite; the outputs tell of them.
    return chosen.nan_to_num(0.0) if chosen.is_floating_point() else chosen, outputs
