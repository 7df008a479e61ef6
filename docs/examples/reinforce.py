"""REINFORCE (Williams 1992) for the expected utility of the return (ESR): an example of an own algorithm.

For the return R = sum_t g^t r_t of an episode and any utility u, the gradient of E[u(R)] is the expectation of
u(R) sum_t grad log pi(a_t | S_t). What an action adds to u(R) depends on the rewards so far, so the policy sees
S_t = (s_t, sum_{i<t} g^i r_i). An update is one episode of every environment; the mean of u(R) is the baseline.
"""

import torch

from mo_deepdrive.learners import Agent
from mo_deepdrive.learners.files.checkpoints import strip_prefix
from mo_deepdrive.learners.hyperparameters import Count, Fraction, LearningRate, NetworkSettings
from mo_deepdrive.learners.networks.actors import make_actor
from mo_deepdrive.learners.networks.optimiser import Adam
from mo_deepdrive.learners.rollouts.collector import Collector


class REINFORCE(Agent):
    """One policy for all vehicles."""

    class Config(NetworkSettings):
        """Hyperparameters."""

        learning_rate: LearningRate = 5e-3
        """Adam's step size."""
        gamma: Fraction = 1.0
        """The discount g."""
        steps: Count = 100
        """Number of decisions in which every episode has ended."""

    def __init__(self, env, utility, **options):
        super().__init__(env, utility, **options)
        env, size = self.env, self.env.observation_size + len(self.env.objectives)
        self.actor = make_actor(self.config, size, env.actions, self.initial, continuous=env.continuous).to(self.device)
        self.optimiser = Adam(self.actor.parameters(), lr=self.config.learning_rate)
        self.collector = Collector(env, self.gamma, self.config.steps)
        self.scales = torch.tensor([*env.observation_scales, *env.objective_scales], device=self.device)

    def inputs(self, observations, accrued):
        seen = torch.cat([torch.as_tensor(observations), torch.as_tensor(accrued)], dim=-1)
        return seen.to(self.device) / self.scales

    @torch.inference_mode()
    def act(self, observations, accrued_reward, generator):
        x = self.inputs(observations, accrued_reward.value)
        return (self.actor.greedy(x) if generator is None else self.actor.sample(x, generator)).cpu().numpy()

    def update(self, progress):
        self.collector.reset(self.env_seed + self.env.num_envs * self.updates)
        rollout, episodes = self.collector.collect(lambda *seen: self.act(*seen, self.generator))
        self.episodes.append(episodes)
        self.step += self.config.steps * self.env.num_envs
        self.updates += 1

        over = (rollout.terminated | rollout.truncated).int()
        first = (over.cumsum(0) == over).float()  # (T, N, V): 1 in the first episode, 0 in those after it
        returns = ((first * rollout.discounts[:-1]).unsqueeze(-1) * rollout.rewards).sum(0)  # (N, V, d): R
        values = torch.stack([u(returns[:, v]) for v, u in enumerate(self.utilities)], dim=-1)  # (N, V): u(R)
        weights = first * (values - values.mean(0)) / (values.std(0, correction=0) + 1e-8)
        x = self.inputs(rollout.observations[:-1], rollout.accrued[:-1])
        log_prob, _ = self.actor(x, rollout.actions.to(self.device))
        loss = -(weights.to(self.device) * log_prob).sum() / first.sum()
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return {"policy_loss": float(loss.detach())}

    def get_state(self):
        state = {f"actor.{name}": tensor for name, tensor in self.actor.state_dict().items()}
        return state | {f"optimiser.{name}": tensor for name, tensor in self.optimiser.get_state().items()}

    def set_state(self, state):
        self.actor.load_state_dict(strip_prefix(state, "actor."))
        self.optimiser.set_state(strip_prefix(state, "optimiser."))
