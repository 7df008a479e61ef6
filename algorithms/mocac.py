"""MOCAC: actor-critic whose critic is the joint distribution of the return, for a known utility under ESR.

After the Multi-Objective Categorical Actor-Critic of Reymond, Hayes, Steckelmacher, Roijers and Nowé (2023,
"Actor-critic multi-objective reinforcement learning for non-linear utility functions", JAAMAS 37:23). The state is
augmented by the accrued reward R_t and its discount g^t. The critic Z predicts the distribution of the rest of the
vector return, not its mean, so that the expected utility of the whole return is known under a non-linear utility u:

    R_t  = sum_{i<t} g^i r_i,    S_t = (s_t, R_t, g^t)                                                 (1)
    Z(S) ~ sum_{k>=0} g^k r_{t+k} from S_t = S,    Z(S) = 0 after termination                          (2)
    V(S) = E_Z[u(R_t + g^t Z(S))]                                                                      (3)
    A_t  = V(S_{t+1}) - V(S_t) + lambda A_{t+1}                                                        (4)
    Y_t  = sum_{k<e-t} g^k r_{t+k} + g^{e-t} Z'(S_e)    targets of the critic                          (5)
    L    = E[-A_t log pi(a_t | S_t)] + c_v E[D(Y_t, Z(S_t))] - c_e E[H(pi)]                            (6)

e is the end of the episode or of the rollout, whichever comes first: every target carries the rewards of the whole rest
of the rollout, so that an outcome n decisions later arrives after about n / T updates. Z' is Z with slowly moving
weights w' <- w' + tau (w - w') (``target_rate``; 1 for Z itself): particles that learn from themselves can diverge, a
grid, which is bounded, cannot. After termination V is u(R_e); what a truncated episode would still have gained is Z of
its true final state. The sum of eq. 4 ends with the episode or the rollout; the means of eq. 6 are over the samples in
which the vehicle acted, with A_t normalised to mean 0 and standard deviation 1 (``normalise_advantages``).

Objective. E[u(R_T)], the expected utility of the return discounted with g (ESR), at any lambda and T: V(S_t) is the
expected final utility, and A_t sums its increases. For lambda = 1 eq. 4 is V(S_e) - V(S_t). g = ``gamma`` is the one
discount; with 1 the utility is that of the undiscounted return. Not taken from the paper: lambda, w', the
normalisation of advantages, g^t in the state, and particles.

Critic. ``categorical``, as published: masses p on a grid of A atoms per objective; D is the cross entropy of p and m,
which is Y_t projected onto the grid by multilinear interpolation (Bellemare et al. 2017 for one objective),

    D(Y, Z) = -sum_j m_j log p_j                                                                       (7)

Bias: returns outside [v_min, v_max] are clipped, and the projection keeps the mean of others, but adds up to a quarter
of the squared spacing to the variance of an objective each time that a target passes through the critic. A^d is limited
to 4096. ``particles``, for more objectives: K equally likely returns x_i, and D is the energy distance (Székely and
Rizzo 2013) between returns divided by their nominal scales, up to a term without x. Zhang et al. (2021) learn joint
returns by particles too, with the maximum mean discrepancy.

    D(Y, Z) = 2 E|x - y| - E|x - x'|                                                                   (8)

Bias: K points stand for the distribution, and targets are clipped to [v_min, v_max], which is wide by default. Whatever
the critic, Z follows the policy with a delay, and as far as it is wrong where a rollout ends (lambda = 1) or at the
next steps (lambda < 1) the advantages are biased.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, Literal

import torch
from pydantic import model_validator

from algorithms.actor_critic import ActorCritic, Learner
from algorithms.files.checkpoints import strip_prefix
from algorithms.hyperparameters import (
    ActorCriticSettings,
    Count,
    FinalLearningRate,
    Fraction,
    LearningRate,
    NonNegative,
    Positive,
    PositiveFraction,
    Scales,
    check_entropy_schedule,
)
from algorithms.networks.actors import make_actor
from algorithms.networks.losses import Losses, mean
from algorithms.networks.modules import make_network
from algorithms.networks.optimiser import Adam
from algorithms.networks.return_distributions import CategoricalGrid, Particles, ReturnDistribution
from algorithms.rollouts.advantages import generalised_advantages, normalise

if TYPE_CHECKING:
    from algorithms.rollouts.buffers import VehicleRollout
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.utilities import Utility


WIDE = 10.0  # bound of particles, in nominal scales


class MOCACConfig(ActorCriticSettings):
    """Hyperparameters of MOCAC; those of actor and critic are described in ActorCriticSettings."""

    learning_rate: LearningRate = 1e-3
    """Adam's step size at the start of training."""
    learning_rate_end: FinalLearningRate | None = None
    """Adam's step size at the end, to which it moves linearly; None for a constant one."""
    gamma: PositiveFraction = 0.99
    """g, discount of the return that the utility judges."""
    gae_lambda: Fraction = 0.95
    """lambda of eq. 4; 0 gives one-step advantages, 1 uses the whole rollout."""
    critic: Literal["particles", "categorical"] = "particles"
    """The critic, "particles" for any number of objectives, or "categorical" for few."""
    atoms: Count = 11
    """A, atoms per objective of a categorical critic; A^d is at most 4096."""
    v_min: list[float] | None = None
    """Smallest rest of a return, per objective, the first atom of a grid or the bound of the particles' targets; None
    for minus the nominal scale on a grid, minus ten times the nominal scale with particles."""
    v_max: list[float] | None = None
    """Largest rest of a return, per objective; None for minus the default of v_min."""
    particles: Count = 32
    """K, of a critic of particles."""
    target_rate: PositiveFraction | None = None
    """tau of the weights of Z'; None for 1 (Z itself) with a grid, 0.05 with particles."""
    observe_discount: bool = True
    """Include g^t in the state, on which V depends where gamma < 1."""
    steps: Count = 16
    """T, time steps per environment and update."""
    entropy_start: NonNegative = 0.01
    """c_e at the start of training."""
    entropy_end: NonNegative = 0.01
    """c_e at the end, to which it moves geometrically."""
    entropy_until: PositiveFraction = 1.0
    """Fraction of the training after which c_e is ``entropy_end``."""
    value_coefficient: Positive = 0.5
    """c_v."""
    max_grad_norm: Positive = 0.5
    """Maximum norm of the gradient."""
    normalise_advantages: bool = True
    """Normalise the advantages of an update to mean 0 and standard deviation 1."""
    objective_scales: Scales | None = None
    """Nominal size of each objective's return; None for the environment's own."""
    centralised_critic: bool = False
    """The critic also sees the observations of the other vehicles; the actor does not."""

    @property
    def tau(self) -> float:
        """``target_rate``, or its default for the critic where that is None."""
        default = 1.0 if self.critic == "categorical" else 0.05
        return default if self.target_rate is None else self.target_rate

    @model_validator(mode="after")
    def _consistent(self) -> MOCACConfig:
        check_entropy_schedule(self.entropy_start, self.entropy_end)
        if self.critic == "categorical" and self.atoms < 2:
            raise ValueError(f"atoms = {self.atoms} must be at least 2")
        return self


class MOCACLearner(Learner):
    """MOCAC for one policy; the arguments are those of :class:`algorithms.actor_critic.Learner`."""

    config: MOCACConfig

    def __init__(
        self,
        env: EnvAdapter,
        vehicles: tuple[int, ...],
        utility: Utility,
        config: MOCACConfig,
        generator: torch.Generator,
        device: torch.device,
    ):
        super().__init__(env, vehicles, utility, config, generator, device)
        # S_t of eq. 1: what the actor and the critic see.
        self.observes_accrued, self.observes_discount = True, config.observe_discount
        self.input_size = env.observation_size + len(env.objectives) + config.observe_discount
        self.distribution = self._distribution(env.objectives)
        self.actor = make_actor(config, self.input_size, env.actions, generator, continuous=env.continuous).to(device)
        width = self.input_size + self.others_size
        self.critic = make_network(config, width, self.distribution.outputs, generator).to(device)
        self.target_critic = copy.deepcopy(self.critic).requires_grad_(requires_grad=False)  # Z'
        self.optimiser = Adam([*self.actor.parameters(), *self.critic.parameters()])

    def _distribution(self, objectives: tuple[str, ...]) -> ReturnDistribution:
        """What the outputs of the critic stand for."""
        config = self.config
        for name, bound in (("v_min", config.v_min), ("v_max", config.v_max)):
            if bound is not None and len(bound) != len(objectives):
                raise ValueError(f"{name} = {bound} needs {len(objectives)} numbers: {objectives}")
        reach = self.objective_scales * (WIDE if config.critic == "particles" else 1.0)
        low = (-reach).tolist() if config.v_min is None else config.v_min
        high = reach.tolist() if config.v_max is None else config.v_max
        if config.critic == "particles":
            return Particles(config.particles, self.objective_scales, low, high)
        return CategoricalGrid(low, high, config.atoms, self.device)

    # ------------------------------------------------------------------------------------------------------ the update

    def update(
        self, rollout: VehicleRollout, learning_rate: float, entropy_coefficient: float, generator: torch.Generator
    ) -> dict[str, float]:
        """One gradient step of eq. 6 on a rollout of T steps in N environments; the losses by name."""
        del generator  # nothing is drawn
        if not rollout.acted.any():
            return {}
        losses = self.loss(rollout, entropy_coefficient)
        self.optimiser.param_groups[0]["lr"] = learning_rate
        self.optimiser.zero_grad()
        losses.total.backward()
        self.optimiser.clip(self.config.max_grad_norm, losses.parts)
        self.optimiser.step()
        with torch.no_grad():
            for slow, weight in zip(self.target_critic.parameters(), self.critic.parameters(), strict=True):
                slow.lerp_(weight, self.config.tau)
        return losses.parts()

    def loss(self, rollout: VehicleRollout, entropy_coefficient: float) -> Losses:
        """L of eq. 6, which autograd differentiates."""
        config = self.config
        inputs = self.inputs(rollout.observations, rollout.accrued, rollout.discounts)
        critic_inputs = self.critic_inputs(inputs, rollout.others)
        outputs: torch.Tensor = self.critic(critic_inputs[:-1].flatten(0, 1))
        ends, end_inputs = self.ends(rollout, critic_inputs)
        with torch.no_grad():
            end_outputs, target_outputs = self.critic(end_inputs), self.target_critic(end_inputs)

        weights = rollout.acted.to(inputs.dtype)
        advantages = self.advantages(rollout, outputs.detach(), ends, end_outputs)
        if config.normalise_advantages:
            advantages = normalise(advantages, weights)

        shifts, discounts, source = self.targets(rollout, ends)
        log_prob, entropies = self.actor(inputs[:-1].flatten(0, 1), rollout.actions.flatten(0, 1))
        weights, advantages = weights.flatten(), advantages.flatten()
        value_loss = mean(self.distribution.distance(outputs, shifts, discounts, target_outputs[source]), weights)
        policy_loss = -mean(advantages * log_prob, weights)
        entropy = mean(entropies, weights)
        total = policy_loss + config.value_coefficient * value_loss - entropy_coefficient * entropy
        return Losses(total, policy_loss, value_loss, entropy)

    def ends(self, rollout: VehicleRollout, critic_inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The states S_e of eq. 5 behind which something may follow: their numbers, and what the critic sees there.

        Args:
            rollout: T steps of this vehicle.
            critic_inputs: (T + 1, N, ...) of S_0 to S_T.

        Returns:
            (T, N) number of the true state after each step that ends a truncated episode or the rollout, else -1; and
            (E, ...) critic inputs by number. The first N are those of S_T.
        """
        steps, n = rollout.acted.shape
        truncated = rollout.truncated & ~rollout.terminated
        numbers = torch.full((steps, n), -1, device=self.device)
        numbers[-1] = torch.arange(n, device=self.device)
        numbers[truncated] = n + torch.arange(int(truncated.sum()), device=self.device)
        if not truncated.any():
            return numbers, critic_inputs[-1]
        final = self.inputs(*rollout.final_states(truncated, self.config.gamma))
        return numbers, torch.cat([critic_inputs[-1], self.critic_inputs(final, rollout.final_others[truncated])])

    def targets(self, rollout: VehicleRollout, ends: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Equation 5 for M = T N samples: the sum of rewards (M, d), g^{e-t} (M,) and the number of S_e (M,).

        The discount is 0 where the episode terminates at e; the number is then any.
        """
        gamma = self.config.gamma
        shifts = rollout.rewards.clone()
        discounts = torch.full_like(rollout.discounts[:-1], gamma)
        source = ends.clamp(min=0)
        over = rollout.terminated | rollout.truncated
        discounts[rollout.terminated] = 0.0
        for t in range(len(shifts) - 2, -1, -1):
            on = ~over[t]
            shifts[t, on] += gamma * shifts[t + 1, on]
            discounts[t, on] = gamma * discounts[t + 1, on]
            source[t, on] = source[t + 1, on]
        return shifts.flatten(0, 1), discounts.flatten(), source.flatten()

    @torch.no_grad()
    def advantages(
        self, rollout: VehicleRollout, outputs: torch.Tensor, ends: torch.Tensor, end_outputs: torch.Tensor
    ) -> torch.Tensor:
        """A_t (T, N) of eq. 4, from the critic's outputs (T N, outputs) at S_t and (E, outputs) at the ends."""
        expected = self.distribution.expected_utility
        accrued, discounts = rollout.accrued[:-1], rollout.discounts[:-1]
        # V(S_t) of eq. 3, and V(S_{t+1}): at first V(S_t) a step later.
        values = expected(self.utility, outputs, accrued.flatten(0, 1), discounts.flatten()).view(discounts.shape)
        next_values = torch.cat([values[1:], torch.zeros_like(values[:1])])
        # Where an episode or the rollout ends, R_{t+1} = R_t + g^t r_t, and Z is that of S_e, or 0 after termination.
        at_end = ends >= 0
        next_accrued = accrued + discounts.unsqueeze(-1) * rollout.rewards
        rest = end_outputs[ends[at_end]]
        next_discounts = self.config.gamma * discounts[at_end]
        next_values[at_end] = expected(self.utility, rest, next_accrued[at_end], next_discounts)
        next_values[rollout.terminated] = self.utility(next_accrued[rollout.terminated])
        ended = rollout.terminated | rollout.truncated
        return generalised_advantages(next_values - values, ended, self.config.gae_lambda)

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def get_state(self) -> dict[str, torch.Tensor]:
        """Weights, those of Z' too, and the optimiser's state."""
        slow = {f"target_critic.{name}": tensor for name, tensor in self.target_critic.state_dict().items()}
        return {**super().get_state(), **slow}

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`."""
        super().set_state(state)
        self.target_critic.load_state_dict(strip_prefix(state, "target_critic."))


class MOCAC(ActorCritic):
    """Multi-objective categorical actor-critic for a known utility, one independent learner per vehicle."""

    name = "mocac"
    Config = MOCACConfig
    learner = MOCACLearner

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must share with the agent that reads it."""
        config = self.config
        size = config.atoms if config.critic == "categorical" else config.particles
        return {**super().identity(), "critic": [config.critic, size, config.v_min, config.v_max]}
