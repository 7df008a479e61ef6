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
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from pydantic import model_validator
from torch import Tensor

from algorithms.actor_critic import ActorCritic
from algorithms.hyperparameters import ActorCriticSettings, Count, PositiveFraction
from algorithms.learning.advantages import generalised_advantages, normalise
from algorithms.learning.learner import Networks
from algorithms.learning.losses import Loss, mean
from mo_deepdrive.evaluation.metrics import ENTROPY, POLICY_LOSS, VALUE_LOSS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from typing_extensions import Self

    from algorithms.actor_critic import PolicyLearner
    from algorithms.learning.storage import Rollout, RolloutStorage
    from mo_deepdrive.utilities import Utility


WIDE = 10.0  # bound of particles, in nominal scales
MAX_CELLS = 4096  # of a grid
MAX_RETURNS = 2**20  # whose utilities are computed at a time
SMOOTHING = 0.01  # of distances between scaled returns, at 0


class MOCACSamples(NamedTuple):
    """M samples of one policy; the other fields are those of :class:`algorithms.learning.storage.Samples`."""

    inputs: Tensor
    states: Tensor
    actions: Tensor
    advantages: Tensor
    shifts: Tensor  # (M, d) the sums of rewards of eq. 5
    discounts: Tensor  # (M,) g^{e-t}; 0 where the episode terminates at e
    following: Tensor  # (M, K) outputs for Z'(S_e)
    weights: Tensor | None = None


class MOCAC(ActorCritic):
    """Multi-objective categorical actor-critic for a known utility, one independent policy per vehicle."""

    name = "mocac"
    samples_class = MOCACSamples
    compiled_saves = 0.05  # the distances between particles
    observes_accrued = True

    class Config(ActorCriticSettings):
        """Hyperparameters of MOCAC; the others are described in ActorCriticSettings."""

        gamma: PositiveFraction = 0.99
        """g, discount of the return that the utility judges."""
        critic: Literal["particles", "categorical"] = "particles"
        """The critic, "particles" for any number of objectives, or "categorical" for few."""
        atoms: Count = 11
        """A, atoms per objective of a categorical critic; A^d is at most 4096."""
        v_min: list[float] | None = None
        """Smallest rest of a return, per objective, the first atom of a grid or the bound of the particles' targets;
        None for minus the nominal scale on a grid, minus ten times the nominal scale with particles."""
        v_max: list[float] | None = None
        """Largest rest of a return, per objective; None for minus the default of v_min."""
        particles: Count = 32
        """K, of a critic of particles."""
        target_rate: PositiveFraction | None = None
        """tau of the weights of Z'; None for 1 (Z itself) with a grid, 0.05 with particles."""
        observe_discount: bool = True
        """Include g^t in the state, on which V depends where gamma < 1."""

        @property
        def tau(self) -> float:
            """``target_rate``, or its default for the critic where that is None."""
            default = 1.0 if self.critic == "categorical" else 0.05
            return default if self.target_rate is None else self.target_rate

        @model_validator(mode="after")
        def _enough_atoms(self) -> Self:
            if self.critic == "categorical" and self.atoms < 2:
                raise ValueError(f"atoms = {self.atoms} must be at least 2")
            return self

    @property
    def observes_discount(self) -> bool:  # type: ignore[override]
        """Whether S_t of eq. 1 has g^t."""
        return bool(self.config.observe_discount)

    def prepare(self) -> None:
        """What the outputs of the critic stand for."""
        config, objectives = self.config, self.env.objectives
        for name, bound in (("v_min", config.v_min), ("v_max", config.v_max)):
            if bound is not None and len(bound) != len(objectives):
                raise ValueError(f"{name} = {bound} needs {len(objectives)} numbers: {objectives}")
        reach = self.objective_scales * (WIDE if config.critic == "particles" else 1.0)
        low = (-reach).tolist() if config.v_min is None else config.v_min
        high = reach.tolist() if config.v_max is None else config.v_max
        if any(least >= most for least, most in zip(low, high, strict=True)):
            raise ValueError(f"v_min = {low} must be below v_max = {high} in every objective")
        self.distribution: ReturnDistribution
        if config.critic == "particles":
            self.distribution = Particles(config.particles, self.objective_scales, low, high)
        else:
            self.distribution = CategoricalGrid(low, high, config.atoms, self.device)

    @property
    def value_scales(self) -> Tensor:
        """(K,) one for every output of the critic, which has no unit."""
        return torch.ones(self.distribution.outputs, device=self.device)

    def make_networks(self, generator: torch.Generator) -> Networks:
        """An actor, a critic, and the critic with slowly moving weights of Z'."""
        made = super().make_networks(generator)
        return Networks(actor=made.actor, critic=made.critic, target_critic=copy.deepcopy(made.critic))

    # ------------------------------------------------------------------------------------------------------ the update

    def learn_once(self, learner: PolicyLearner, storage: RolloutStorage) -> dict[str, Tensor]:
        """One gradient step of eq. 6 on a rollout, then one of the weights of Z'; the parts of the loss."""
        losses = super().learn_once(learner, storage)
        slow = learner.parameters("target_critic")
        for name, weight in learner.parameters("critic").items():
            slow[f"target_{name}"].lerp_(weight, self.config.tau)
        return losses

    def samples(self, networks: Networks, rollout: Rollout) -> MOCACSamples:
        """What one seed learns from its rollout, (T, N, ...): the terms of eq. 6 that have no gradient."""
        # V(S_0) to V(S_T) of eq. 3, and V(S_{t+1}) where an episode ends.
        expected = self._expected(rollout, networks.critic(rollout.states), rollout.accrued, rollout.discounts)
        following, next_values = torch.zeros_like(networks.critic(rollout.states[1:])), expected[1:]
        if self.collector.static or rollout.truncated.any():
            following = networks.target_critic(rollout.final_states)
            outputs, discounts = networks.critic(rollout.final_states), self.config.gamma * rollout.discounts[:-1]
            final = self._expected(rollout, outputs, rollout.next_accrued, discounts)
            next_values = torch.where(rollout.truncated, final, next_values)
        next_values = torch.where(rollout.terminated, rollout.utility(rollout.next_accrued), next_values)
        advantages = self.advantages(rollout, expected[:-1], next_values)[0]
        weights = rollout.acted.to(advantages.dtype)
        if self.config.normalise_advantages:
            advantages = normalise(advantages, weights)
        # Z'(S_e): of the true final state of a truncated episode, else of S_T.
        at_end = torch.where(
            rollout.truncated[-1:, :, None], following[-1:], networks.target_critic(rollout.states[-1:])
        )
        targets = self.targets(rollout, torch.cat([following[:-1], at_end]))
        seen = rollout.inputs[:-1], rollout.states[:-1]
        return MOCACSamples(*seen, rollout.actions, advantages, *targets, weights=weights)

    def _expected(self, rollout: Rollout, outputs: Tensor, accrued: Tensor, discounts: Tensor) -> Tensor:
        """E[u(R + D Z)] (T, N) for outputs (T, N, K) of the critic, R (T, N, d) and D (T, N)."""
        parts = (outputs.flatten(0, 1), accrued.flatten(0, 1), discounts.flatten())
        return self.distribution.expected_utility(rollout.utility, *parts).view_as(discounts)

    def targets(self, rollout: Rollout, following: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Equation 5: the sum of rewards (T, N, d), g^{e-t} (T, N), 0 after termination, and Z'(S_e) (T, N, K).

        ``following`` (T, N, K) are outputs for Z' behind the steps in which an episode is truncated, and the last.
        """
        gamma, on, stays = self.config.gamma, ~rollout.ended, (~rollout.terminated).to(rollout.rewards.dtype)
        shifts, discounts, sources = [rollout.rewards[-1]], [gamma * stays[-1]], [following[-1]]
        for t in range(len(rollout.rewards) - 2, -1, -1):
            shifts.append(rollout.rewards[t] + gamma * on[t].unsqueeze(-1) * shifts[-1])
            discounts.append(gamma * torch.where(on[t], discounts[-1], stays[t]))
            sources.append(torch.where(on[t].unsqueeze(-1), sources[-1], following[t]))
        return torch.stack(shifts[::-1]), torch.stack(discounts[::-1]), torch.stack(sources[::-1])

    def advantages(self, rollout: Rollout, values: Tensor, next_values: Tensor) -> tuple[Tensor, Tensor]:
        """A_t (T, N) of eq. 4 from V(S_t) and V(S_{t+1}) (T, N), and V(S_{t+1}): the critic's targets are of eq. 5."""
        return generalised_advantages(next_values - values, rollout.ended, self.config.gae_lambda), next_values

    def loss(self, networks: Networks, samples: MOCACSamples, entropy_coefficient: Tensor) -> Loss:
        """L of eq. 6."""
        log_prob, entropies = networks.actor(samples.inputs, samples.actions)
        distances = self.distribution.distance(
            networks.critic(samples.states), samples.shifts, samples.discounts, samples.following
        )
        policy_loss = -mean(samples.advantages * log_prob, samples.weights)
        value_loss = mean(distances, samples.weights)
        entropy = mean(entropies, samples.weights)
        total = policy_loss + self.config.value_coefficient * value_loss - entropy_coefficient * entropy
        return Loss(total, {POLICY_LOSS: policy_loss, VALUE_LOSS: value_loss, ENTROPY: entropy})

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must share with the agent that reads it."""
        config = self.config
        size = config.atoms if config.critic == "categorical" else config.particles
        return {**super().identity(), "critic": [config.critic, size, config.v_min, config.v_max]}


# ------------------------------------------------------------------------------------------ distributions of the return


class ReturnDistribution(ABC):
    """A family of joint distributions of d returns, parametrised by the outputs of a network."""

    outputs: int  # width of the network's output

    @abstractmethod
    def support(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """The returns that have mass, (M, n, d) or (1, n, d) where all rows share them, and their masses (M, n)."""

    @abstractmethod
    def distance(self, outputs: Tensor, shifts: Tensor, discounts: Tensor, following: Tensor) -> Tensor:
        """D(target, prediction) (M,) of the predictions ``outputs`` (M, outputs).

        The target is the distribution of shift (M, d) + discount (M,) Z, of which ``following`` are the outputs.
        """

    def expected_utility(self, utility: Utility, outputs: Tensor, accrued: Tensor, discounts: Tensor) -> Tensor:
        """E[u(R + D Z)] (M,), from the outputs (M, outputs) for Z, R (M, d) and D (M,)."""
        returns, masses = self.support(outputs)
        rows = max(1, MAX_RETURNS // returns[0].numel())
        parts = [each.split(rows) for each in (returns.expand(len(outputs), -1, -1), masses, accrued, discounts)]
        return torch.cat(
            [
                (mass * utility(past.unsqueeze(1) + discount[:, None, None] * rest)).sum(-1)
                for rest, mass, past, discount in zip(*parts, strict=True)
            ]
        )


class CategoricalGrid(ReturnDistribution):
    """Masses on a regular grid of A atoms per objective, softmax of A^d logits (Reymond et al. 2023, section 4).

    The joint form of Bellemare, Dabney and Munos (2017). The loss is the cross entropy between the target, projected
    onto the grid by :func:`project`, and the prediction. ``minimum`` and ``maximum`` (d,) are the first and last atoms.
    """

    def __init__(self, minimum: Sequence[float], maximum: Sequence[float], atoms: int, device: torch.device):
        self.objectives, self.atoms = len(minimum), atoms
        self.outputs = atoms**self.objectives
        if self.outputs > MAX_CELLS:
            raise ValueError(
                f"atoms = {atoms} for {self.objectives} objectives makes a grid of {atoms}^{self.objectives} = "
                f"{self.outputs:,} cells; at most {MAX_CELLS:,} are allowed: choose fewer atoms, or critic: particles"
            )
        # (A, d): one column of atoms per objective, and all their combinations (1, A^d, d).
        columns = [torch.linspace(low, high, atoms) for low, high in zip(minimum, maximum, strict=True)]
        self.values = torch.stack(columns, dim=1).to(device)
        points = torch.stack(torch.meshgrid(*columns, indexing="ij"), dim=-1)
        self.points = points.reshape(1, self.outputs, self.objectives).to(device)

    def support(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """The grid's points (1, A^d, d), and softmax of the logits."""
        return self.points, outputs.softmax(-1)

    def distance(self, outputs: Tensor, shifts: Tensor, discounts: Tensor, following: Tensor) -> Tensor:
        """-m . log p for the projected targets m."""
        targets = project(following.softmax(-1), shifts, discounts, self.values)
        return -(targets * outputs.log_softmax(-1)).sum(-1)


def project(masses: Tensor, shifts: Tensor, discounts: Tensor, values: Tensor) -> Tensor:
    """The distribution of shift + discount Z, with Z on a grid, back onto that grid: (M, A^d).

    Every atom is clipped to the grid, and its mass shared among the 2^d corners of its cell by multilinear
    interpolation: for an atom b of an objective, in units of the spacing from its first atom, atom i receives the
    factor max(0, 1 - abs(b - i)). The means of atoms inside the grid are kept, and variances never become smaller.

    The last objective of the masses (M, A^d) varies fastest; ``values`` (A, d) are evenly spaced atoms.
    """
    atoms, d = values.shape
    number = torch.arange(atoms, dtype=values.dtype, device=values.device)
    spacing = (values[-1] - values[0]) / (atoms - 1)
    result = masses.reshape(len(masses), atoms, -1)
    for k in range(d):
        moved = shifts[:, k, None] + discounts.unsqueeze(-1) * values[:, k]
        position = ((moved - values[0, k]) / spacing[k]).clamp(0.0, atoms - 1.0)
        factors = (1.0 - (position.unsqueeze(1) - number.unsqueeze(-1)).abs()).clamp(min=0.0)  # (M, A to, A from)
        # The first objective's axis is contracted and becomes the last, so that after d rounds the order is as before.
        result = (factors @ result).transpose(1, 2).reshape(len(masses), atoms, -1)
    return result.reshape(len(masses), -1)


class Particles(ReturnDistribution):
    """K equally likely joint returns, trained by the energy distance to the target's (Székely and Rizzo 2013).

    Distances are measured in units of ``scales`` (d,), and targets are clipped to the bounds (d,).
    """

    def __init__(self, number: int, scales: Tensor, minimum: Sequence[float], maximum: Sequence[float]):
        self.number, self.scales = number, scales
        self.minimum, self.maximum = (scales.new_tensor(bound) / scales for bound in (minimum, maximum))
        self.outputs = number * len(scales)

    def support(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """The particles (M, K, d), each of mass 1 / K."""
        particles = outputs.unflatten(-1, (self.number, -1))
        return self.scales * particles, torch.full_like(particles[..., 0], 1.0 / self.number)

    def distance(self, outputs: Tensor, shifts: Tensor, discounts: Tensor, following: Tensor) -> Tensor:
        """:func:`energy_score` between returns divided by their scales."""
        moved = discounts[:, None, None] * following.unflatten(-1, (self.number, -1))
        targets = ((shifts / self.scales).unsqueeze(1) + moved).clamp(self.minimum, self.maximum)
        return energy_score(outputs.unflatten(-1, (self.number, -1)), targets)


def energy_score(particles: Tensor, targets: Tensor) -> Tensor:
    """``2 E|X - Y| - E|X - X'|`` (M,).

    This is the energy distance between particles and targets but for ``E|Y - Y'|``, which does not depend on the
    particles. It is linear in the distribution of Y, so that single outcomes give unbiased gradients, and smallest
    where X and Y have the same distribution (Gneiting and Raftery 2007, section 4.3). With
    ``|z| = sqrt(z . z + 0.01^2)``, which has a gradient at 0, it is a maximum mean discrepancy with a multiquadric
    kernel, as in Zhang et al. (2021).

    X are the particles (M, K, d), and Y the targets (M, J, d), without a gradient.
    """

    def distance(others: Tensor) -> Tensor:
        # |x - y|^2 = |x|^2 + |y|^2 - 2 x . y, so that nothing is (M, K, J, d).
        squares = particles.square().sum(-1).unsqueeze(-1) + others.square().sum(-1).unsqueeze(-2)
        squares = torch.baddbmm(squares, particles, others.transpose(1, 2), alpha=-2.0)
        return (squares.clamp(min=0.0) + SMOOTHING**2).sqrt().mean((-2, -1))

    return 2.0 * distance(targets) - distance(particles)
