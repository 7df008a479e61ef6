"""MAPPO: PPO for a team of vehicles (Yu et al. 2022) that maximises a joint utility of their returns.

The team's utility is J(u_1(R_1), ..., u_V(R_V)): a joint utility J of each
vehicle's utility of its own undiscounted return. The team's episode lasts until the last of its vehicles has ended, so
that a vehicle is also paid for what happens to the others after its own end. With R_{v,t} = sum_{i<t} r_{v,i}, the
team's reward is the increase of its utility, and S_t is what all vehicles observe, all R_{v,t}, and who is still under
way:

    r_t     = J(u(R_{t+1})) - J(u(R_t))                                                     (1)
    delta_t = r_t + gamma v(S_{t+1}) - v(S_t)                                               (2)
    A_t     = delta_t + gamma lambda A_{t+1},    y_t = A_t + v(S_t)                         (3)

The rewards of an episode sum to the utility of its returns less that of no return. So with gamma = 1 the objective is
E[J(u(R_T))], the expected utility of the team's returns (ESR); gamma < 1 discounts its increases.

Every vehicle has an actor, which sees what this vehicle observes, and a critic v of its own, which sees S_t; nothing is
shared. Both learn as in PPO, the actor from the steps in which its vehicle acted, the critic from all steps:

    rho_t = pi(a_t | s_t) / pi_old(a_t | s_t)                                               (4)
    L     = -E[min(rho_t A_t, clip(rho_t, 1 - epsilon, 1 + epsilon) A_t)]
            + c_v E[(y_t - v(S_t))^2] - c_e E[H(pi)]                                        (5)

The actors do not see the accrued rewards R_{v,t}. Where u or J is not linear, a policy that does could be better.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, cast

import torch
from pydantic import Field, model_validator

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
from algorithms.networks.losses import Losses, means, policy_change, proximal_loss
from algorithms.networks.modules import make_network
from algorithms.networks.optimiser import Adam
from algorithms.rollouts.advantages import generalised_advantages, next_values, normalise
from algorithms.rollouts.buffers import Samples

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from gymnasium.vector import VectorEnv

    from algorithms.rollouts.buffers import Rollout, VehicleRollout
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.evaluation.episodes import UtilityLike
    from mo_deepdrive.utilities import Utility


JointUtility = Literal["sum", "worst_off", "gini"]


def total(utilities: torch.Tensor) -> torch.Tensor:
    """The sum: nobody counts for more than another (utilitarian)."""
    return utilities.sum(dim=-1)


def worst_off(utilities: torch.Tensor) -> torch.Tensor:
    """The least one (egalitarian)."""
    return utilities.amin(dim=-1)


def generalised_gini(utilities: torch.Tensor) -> torch.Tensor:
    """The sum of 2^-k u_k over the utilities u_1 <= u_2 <= ... from the worst-off on.

    Between the two others: a gain counts for more where it goes to somebody worse off (Weymark 1981, "Generalized Gini
    inequality indices"; Siddique et al. 2020 use it for fair policies).
    """
    weights = 0.5 ** torch.arange(1, utilities.shape[-1] + 1, dtype=utilities.dtype, device=utilities.device)
    return (utilities.sort(dim=-1).values * weights).sum(dim=-1)


JOINT_UTILITIES: dict[JointUtility, Callable[[torch.Tensor], torch.Tensor]] = {
    "sum": total,
    "worst_off": worst_off,
    "gini": generalised_gini,
}


def joint_utility(
    name: JointUtility, utilities: Sequence[Callable[[torch.Tensor], torch.Tensor]], returns: torch.Tensor
) -> torch.Tensor:
    """J(u_1(R_1), ..., u_V(R_V)) (...) of the returns (..., V, d) of V vehicles."""
    each = [utility(returns[..., v, :]) for v, utility in enumerate(utilities)]
    return JOINT_UTILITIES[name](torch.stack(each, dim=-1))


class MAPPOConfig(ActorCriticSettings):
    """Hyperparameters of MAPPO; those of actor and critic are described in ActorCriticSettings."""

    joint: JointUtility = "sum"
    """J, the joint utility, which is "sum", "worst_off" or "gini"."""
    learning_rate: LearningRate = 1e-3
    """Adam's step size at the start of training."""
    learning_rate_end: FinalLearningRate | None = None
    """Adam's step size at the end, to which it moves linearly; None for a constant one."""
    gamma: Fraction = 1.0
    """Discount of the team's rewards."""
    gae_lambda: Fraction = 0.95
    """lambda of eq. 3; 0 gives one-step advantages, 1 uses the whole rollout."""
    steps: Count = 16
    """T, time steps per environment and update."""
    epochs: Annotated[int, Field(ge=1, le=100)] = 4
    """Passes over every rollout."""
    minibatches: Count = 4
    """Gradient steps per pass."""
    clip: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.2
    """epsilon of eq. 5."""
    entropy_start: NonNegative = 0.01
    """c_e at the start of training."""
    entropy_end: NonNegative = 0.01
    """c_e at the end, to which it moves geometrically."""
    entropy_until: PositiveFraction = 1.0
    """Fraction of the training after which c_e is ``entropy_end``."""
    value_coefficient: Positive = 0.5
    """c_v."""
    value_scale: Positive = 10.0
    """Nominal size of the team's utility, by which the critic's output is multiplied."""
    max_grad_norm: Positive = 0.5
    """Maximum norm of the gradient."""
    objective_scales: Scales | None = None
    """Nominal size of each objective's return; None for the environment's own."""

    @model_validator(mode="after")
    def _consistent(self) -> MAPPOConfig:
        check_entropy_schedule(self.entropy_start, self.entropy_end)
        return self

    @property
    def centralised_critic(self) -> bool:
        """What others observe is a part of S_t, not of a vehicle's own rollout."""
        return False


class TeamRollout(NamedTuple):
    """T steps of N teams.

    Attributes:
        rewards: (T, N) of eq. 1.
        states: (T + 1, N, s) S_t, scaled.
        final_states: (T, N, s) S_{t+1} where a team's episode was truncated at t, else undefined.
        terminated, truncated: (T, N) whether the team's episode ended at t; never both.
    """

    rewards: torch.Tensor
    states: torch.Tensor
    final_states: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor

    def of_each(self, vehicles: int) -> TeamRollout:
        """The same for each of some vehicles that share a policy, (..., N vehicles, ...)."""
        return TeamRollout(*(each.repeat_interleave(vehicles, dim=1) for each in self))


class TeamEpisodes:
    """Follows the episodes of N teams from rollout to rollout.

    Args:
        env: where the vehicles drive.
        joint: J.
        utilities: one per vehicle.
        objective_scales: (d,) nominal size of each objective's return.
    """

    def __init__(
        self, env: EnvAdapter, joint: JointUtility, utilities: Sequence[Utility], objective_scales: torch.Tensor
    ):
        self._joint = joint
        self.utilities = utilities
        device = objective_scales.device
        self._observation_scales = torch.from_numpy(env.observation_scales).to(device)
        self._objective_scales = objective_scales
        self.begin(env.num_envs, env.vehicles)

    def begin(self, *shape: int) -> None:
        """Begin episodes of vehicles of this shape, (N, V) or with further axes before them."""
        d, device = len(self._objective_scales), self._objective_scales.device
        # R_{v,t} of the running episodes, and whether the vehicle has ended.
        self.returns = torch.zeros(*shape, d, device=device)
        self.ended = torch.zeros(shape, dtype=torch.bool, device=device)

    def follow(self, rollout: Rollout) -> TeamRollout:
        """The team's part of a rollout that continues the last one."""
        steps = len(rollout.acted)
        before, after = (self.returns.new_empty(steps, *self.returns.shape) for _ in range(2))
        ended = self.ended.new_empty(steps + 1, *self.ended.shape)
        finally_ended = self.ended.new_empty(steps, *self.ended.shape)
        terminated, truncated = (self.ended.new_zeros(steps, *self.ended.shape[:-1]) for _ in range(2))
        for t in range(steps):
            acted, cut = rollout.acted[t], rollout.truncated[t] & ~rollout.terminated[t]
            before[t], ended[t] = self.returns, self.ended
            after[t] = self.returns + rollout.rewards[t] * acted.unsqueeze(-1)
            # Of the true final state of a team that is cut: a vehicle that is cut is still under way in it.
            finally_ended[t] = self.ended | (acted & rollout.terminated[t])
            self.ended = self.ended | (acted & (rollout.terminated[t] | rollout.truncated[t]))
            over = self.ended.all(dim=-1)
            truncated[t] = over & (acted & cut).any(dim=-1)
            terminated[t] = over & ~truncated[t]
            self.returns = after[t].masked_fill(over[..., None, None], 0.0)
            self.ended = self.ended & ~over.unsqueeze(-1)
        ended[steps] = self.ended
        # Equation 1.
        utilities = [joint_utility(self._joint, self.utilities, returns) for returns in (before, after)]
        states = self._states(rollout.observations, torch.cat([before, self.returns.unsqueeze(0)]), ended)
        final_states = self._states(rollout.final, after, finally_ended)
        return TeamRollout(utilities[1] - utilities[0], states, final_states, terminated, truncated)

    def _states(self, observations: torch.Tensor, returns: torch.Tensor, ended: torch.Tensor) -> torch.Tensor:
        """S (..., s), scaled, from observations (..., V, o), returns (..., V, d) and who has ended (..., V)."""
        parts = (observations / self._observation_scales).flatten(-2), (returns / self._objective_scales).flatten(-2)
        return torch.cat([*parts, ended.to(observations.dtype)], dim=-1)


class MAPPOLearner(Learner):
    """MAPPO for one policy; the arguments are those of :class:`algorithms.actor_critic.Learner`."""

    config: MAPPOConfig

    def __init__(
        self,
        env: EnvAdapter,
        vehicles: tuple[int, ...],
        utility: Utility,
        config: MAPPOConfig,
        generator: torch.Generator,
        device: torch.device,
    ):
        super().__init__(env, vehicles, utility, config, generator, device)
        self.input_size = env.observation_size
        state_size = env.vehicles * (env.observation_size + len(env.objectives) + 1)
        self.actor = make_actor(config, self.input_size, env.actions, generator, continuous=env.continuous).to(device)
        self.critic = make_network(config, state_size, 1, generator).to(device)
        self.value_scales = torch.tensor([config.value_scale], device=device)
        self.optimiser = Adam([*self.actor.parameters(), *self.critic.parameters()])
        self.team: TeamRollout  # of the rollout that is learnt from

    # ------------------------------------------------------------------------------------------------------ the update

    def update(
        self, rollout: VehicleRollout, learning_rate: float, entropy_coefficient: float, generator: torch.Generator
    ) -> dict[str, float]:
        """Epochs of minibatch steps of eq. 5 on a rollout of T steps in N environments; mean losses by name."""
        config, samples, steps = self.config, self.samples(rollout), []
        if not rollout.acted.any():
            return {}
        self.optimiser.param_groups[0]["lr"] = learning_rate
        for minibatch in samples.minibatches(config.epochs, config.minibatches, generator):
            losses = self.loss(minibatch, entropy_coefficient)
            self.optimiser.zero_grad()
            losses.total.backward()
            self.optimiser.clip(config.max_grad_norm, losses.parts)
            self.optimiser.step()
            steps.append(losses)
        return {**means(steps), **policy_change(steps, config.clip)}

    @torch.no_grad()
    def samples(self, rollout: VehicleRollout) -> Samples:
        """What is learnt from a rollout, (T N, ...): A_t, y_t and log pi_old of the networks as they are now.

        All count for the critic, and those in which the vehicle acted for the actor.
        """
        team, inputs = self.team, self.inputs(rollout.observations[:-1], rollout.accrued[:-1], rollout.discounts[:-1])
        values = self.values(team.states)
        following = self.next_values(rollout, values)
        # Equations 2 and 3.
        ended, gamma = (team.terminated | team.truncated).unsqueeze(-1), self.config.gamma
        deltas = team.rewards.unsqueeze(-1) + gamma * following - values[:-1]
        vector = generalised_advantages(deltas, ended, gamma * self.config.gae_lambda)
        weights = rollout.acted.to(values.dtype)
        advantages, targets = normalise(vector.squeeze(-1), weights), (vector + values[:-1]) / self.value_scales
        log_prob, _ = self.actor(inputs, rollout.actions)
        return Samples(inputs, team.states[:-1], rollout.actions, advantages, targets, weights, log_prob).flat()

    def next_values(self, rollout: VehicleRollout, values: torch.Tensor) -> torch.Tensor:
        """v(S_{t+1}) (T, N, 1) of the team's states, from those (T + 1, N, 1) of S_0 to S_T."""
        return next_values(values[1:], self.final_values(rollout), self.team.terminated, self.team.truncated)

    def final_values(self, rollout: VehicleRollout) -> torch.Tensor:
        """V (T, N, 1) of the true states after steps that truncated a team's episode; anything after other steps."""
        del rollout  # this vehicle's
        truncated, states = self.team.truncated, self.team.final_states
        if self.static_shapes:
            return self.values(states)
        found = torch.zeros((*truncated.shape, 1), device=self.device)
        if truncated.any():
            found[truncated] = self.values(states[truncated])
        return found

    def loss(self, samples: Samples, entropy_coefficient: float | torch.Tensor) -> Losses:
        """L of eq. 5, a function of tensors that autograd differentiates."""
        log_prob, entropies = self.actor(samples.inputs, samples.actions)
        outputs = self.critic(samples.critic_inputs)
        return proximal_loss(
            log_prob, entropies, outputs, samples, self.config, entropy_coefficient, critic_learns_from_all=True
        )


class MAPPO(ActorCritic):
    """Multi-agent PPO for a joint utility; every vehicle has an actor and a critic that sees the whole team."""

    name = "mappo"
    Config = MAPPOConfig
    learner = MAPPOLearner
    trains_on_devices = True
    trains_with_guides = False  # the team's return would go on where the guide's decisions are not learnt from

    def __init__(self, env: VectorEnv, utility: UtilityLike | Sequence[UtilityLike], **options: Any):
        super().__init__(env, utility, **options)
        if self.env.vehicles == 1:
            raise ValueError(f"{self.env.name} has one vehicle; algorithm {self.name!r} is for a team")
        config = self.config
        self.team = TeamEpisodes(self.env, config.joint, self.utilities, self.learners[0].objective_scales)

    def begin(self) -> None:
        """Reset the environments."""
        super().begin()
        self.team.begin(self.env.num_envs, self.env.vehicles)

    def learn(self, rollout: Rollout, learning_rate: float, entropy_coefficient: float) -> dict[str, float]:
        """Each learner learns from its vehicle's part of the rollout and from the team's."""
        team = self.team.follow(rollout)
        for learner in self.learners:
            cast("MAPPOLearner", learner).team = team.of_each(len(learner.vehicles))
        return super().learn(rollout, learning_rate, entropy_coefficient)

    def get_state(self) -> dict[str, torch.Tensor]:
        """Learners, environments and the teams' running episodes."""
        return {**super().get_state(), "team.returns": self.team.returns, "team.ended": self.team.ended}

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`.

        Raises:
            ValueError: for values from which training cannot continue.
        """
        super().set_state(state)
        team = strip_prefix(state, "team.")
        if team["ended"].all(dim=-1).any():
            raise ValueError("the teams' running episodes are broken: nobody is under way")
        self.team.returns, self.team.ended = team["returns"].clone(), team["ended"].clone()
