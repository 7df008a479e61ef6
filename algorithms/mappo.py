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

from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from algorithms.hyperparameters import Fraction, Positive, ProximalSettings
from algorithms.learning.advantages import generalised_advantages
from algorithms.learning.losses import Loss, mean, policy_change
from algorithms.ppo import PPO
from mo_deepdrive.evaluation.metrics import ENTROPY, POLICY_LOSS, VALUE_LOSS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from gymnasium.vector import VectorEnv

    from algorithms.actor_critic import PolicyLearner
    from algorithms.learning.learner import Networks
    from algorithms.learning.storage import Rollout, RolloutStorage, Samples
    from mo_deepdrive.evaluation.episodes import UtilityLike


JointUtility = Literal["sum", "worst_off", "gini"]


def generalised_gini(utilities: Tensor) -> Tensor:
    """The sum of 2^-k u_k over the utilities u_1 <= u_2 <= ... from the worst-off on.

    Between the two others: a gain counts for more where it goes to somebody worse off (Weymark 1981, "Generalized Gini
    inequality indices"; Siddique et al. 2020 use it for fair policies).
    """
    weights = 0.5 ** torch.arange(1, utilities.shape[-1] + 1, dtype=utilities.dtype, device=utilities.device)
    return (utilities.sort(dim=-1).values * weights).sum(dim=-1)


JOINT_UTILITIES: dict[JointUtility, Callable[[Tensor], Tensor]] = {
    "sum": lambda utilities: utilities.sum(dim=-1),  # nobody counts for more than another (utilitarian)
    "worst_off": lambda utilities: utilities.amin(dim=-1),  # only the least one counts (egalitarian)
    "gini": generalised_gini,
}


def joint_utility(name: JointUtility, utilities: Sequence[Callable[[Tensor], Tensor]], returns: Tensor) -> Tensor:
    """J(u_1(R_1), ..., u_V(R_V)) (...) of the returns (..., V, d) of V vehicles."""
    each = [utility(returns[..., v, :]) for v, utility in enumerate(utilities)]
    return JOINT_UTILITIES[name](torch.stack(each, dim=-1))


class MAPPO(PPO):
    """Multi-agent PPO for a joint utility; every vehicle has an actor and a critic that sees the whole team.

    Attributes:
        returns: (S, N, V, d) R_{v,t} of the running episodes of the teams.
        team_ended: (S, N, V) whether the vehicle has ended in them.
    """

    name = "mappo"
    trains_with_guides = False  # the team's return would go on where the guide's decisions are not learnt from

    class Config(ProximalSettings):
        """Hyperparameters of MAPPO; the others are described in ProximalSettings and ActorCriticSettings."""

        joint: JointUtility = "sum"
        """J, the joint utility, which is "sum", "worst_off" or "gini"."""
        gamma: Fraction = 1.0
        """Discount of the team's rewards."""
        value_scale: Positive = 10.0
        """Nominal size of the team's utility, by which the critic's output is multiplied."""
        centralised_critic: Literal[False] = False
        """False: what the other vehicles observe is a part of S_t already."""

    def __init__(self, env: VectorEnv, utility: UtilityLike | Sequence[UtilityLike], **options: Any):
        super().__init__(env, utility, **options)
        if self.env.vehicles == 1:
            raise ValueError(f"{self.env.name} has one vehicle; algorithm {self.name!r} is for a team")
        shape = len(self.seeds), self.env.num_envs, self.env.vehicles
        self.returns = torch.zeros(*shape, len(self.env.objectives), device=self.device)
        self.team_ended = torch.zeros(shape, dtype=torch.bool, device=self.device)

    def advantages(self, rollout: Rollout, values: Tensor, next_values: Tensor) -> tuple[Tensor, Tensor]:
        """A_t (T, N) and y_t (T, N, 1) of eqs. 2 and 3, from the team's r_t, v(S_t) and v(S_{t+1}) (T, N, 1)."""
        gamma, ended = self.config.gamma, rollout.ended.unsqueeze(-1)
        deltas = rollout.rewards + gamma * next_values - values  # eq. 2
        advantages = generalised_advantages(deltas, ended, gamma * self.config.gae_lambda)
        return advantages.squeeze(-1), advantages + values  # eq. 3

    def loss(self, networks: Networks, samples: Samples, entropy_coefficient: Tensor) -> Loss:
        """L of eq. 5: the actor learns from the steps in which its vehicle acted, the critic from all."""
        config, weights = self.config, samples.weights
        log_prob, entropies = networks.actor(samples.inputs, samples.actions)
        log_ratio = log_prob - samples.log_prob
        ratio = log_ratio.exp()  # eq. 4
        clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
        policy_loss = -mean(torch.minimum(ratio * samples.advantages, clipped * samples.advantages), weights)
        value_loss = (samples.targets - networks.critic(samples.states)).square().mean()
        entropy = mean(entropies, weights)
        total = policy_loss + config.value_coefficient * value_loss - entropy_coefficient * entropy
        parts = {POLICY_LOSS: policy_loss, VALUE_LOSS: value_loss, ENTROPY: entropy}
        return Loss(total, {**parts, **policy_change(log_ratio, config.clip, weights)})

    # -------------------------------------------------------------------------------------------------------- the team

    @property
    def state_size(self) -> int:
        """Width of S_t: of every vehicle what it observes, R_{v,t}, and whether it has ended."""
        return self.env.vehicles * (self.env.observation_size + len(self.env.objectives) + 1)

    def begin(self) -> None:
        """Reset the environments."""
        super().begin()
        self.returns.zero_()
        self.team_ended.zero_()

    def before_learning(self, storage: RolloutStorage) -> None:
        """Follow the teams' episodes through a rollout that continues the last one: r_t, S_t and where they end."""
        before, after = torch.empty_like(storage.rewards), torch.empty_like(storage.rewards)
        ended, finally_ended = torch.empty_like(storage.acted), torch.empty_like(storage.acted)
        terminated, truncated = (torch.zeros_like(storage.acted[..., 0]) for _ in range(2))
        for t in range(storage.rewards.shape[1]):
            acted, cut = storage.acted[:, t], storage.truncated[:, t] & ~storage.terminated[:, t]
            before[:, t], ended[:, t] = self.returns, self.team_ended
            after[:, t] = self.returns + storage.rewards[:, t] * acted.unsqueeze(-1)
            # Of the true final state of a team that is cut: a vehicle that is cut is still under way in it.
            finally_ended[:, t] = self.team_ended | (acted & storage.terminated[:, t])
            self.team_ended |= acted & (storage.terminated[:, t] | storage.truncated[:, t])
            over = self.team_ended.all(dim=-1)
            truncated[:, t] = over & (acted & cut).any(dim=-1)
            terminated[:, t] = over & ~truncated[:, t]
            self.returns.copy_(after[:, t].masked_fill(over[..., None, None], 0.0))
            self.team_ended &= ~over.unsqueeze(-1)
        ended = torch.cat([ended, self.team_ended.unsqueeze(1)], dim=1)
        utilities = [each.unchecked() for each in self.utilities]
        gains = [joint_utility(self.config.joint, utilities, returns) for returns in (after, before)]
        self._team = {
            "rewards": (gains[0] - gains[1]).unsqueeze(-1),  # eq. 1
            "states": self._states(storage.inputs, torch.cat([before, self.returns.unsqueeze(1)], dim=1), ended),
            "final_states": self._states(storage.final_inputs, after, finally_ended),
            "terminated": terminated,
            "truncated": truncated,
        }

    def _states(self, observations: Tensor, returns: Tensor, ended: Tensor) -> Tensor:
        """S (..., s) from scaled observations (..., V, o), returns (..., V, d) and who has ended (..., V)."""
        parts = observations.flatten(-2), (returns / self.objective_scales).flatten(-2)
        return torch.cat([*parts, ended.to(observations.dtype)], dim=-1)

    def rollout_of(self, learner: PolicyLearner, storage: RolloutStorage) -> dict[str, Tensor]:
        """What a policy did, with the team's rewards, states and ends; the same for vehicles that share a policy."""
        vehicles = len(learner.vehicles)
        team = {name: each.repeat_interleave(vehicles, dim=2) for name, each in self._team.items()}
        return {**super().rollout_of(learner, storage), **team}

    @property
    def running(self) -> dict[str, Tensor]:
        """The teams' running episodes."""
        return {"team.returns": self.returns, "team.ended": self.team_ended}
