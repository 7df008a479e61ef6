"""REINFORCE (Williams 1992) for the expected utility of the return (ESR): an example of an own algorithm.

For the return R = sum_t r_t of an episode and any utility u, the gradient of E[u(R)] is the expectation of
u(R) sum_t grad log pi(a_t | S_t). What an action adds to u(R) depends on the rewards so far, so the policy sees
S_t = (s_t, sum_{i<t} r_i). An update is one episode of every environment; the mean of u(R) is the baseline.
"""

import math

import numpy as np
import torch

from mo_deepdrive.evaluation.metrics import POLICY_LOSS
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.learners import Agent
from mo_deepdrive.learners.hyperparameters import LearningRate, NetworkSettings
from mo_deepdrive.learners.learning.actors import make_actor
from mo_deepdrive.learners.learning.learner import Learner, Networks
from mo_deepdrive.learners.learning.losses import Loss


class REINFORCE(Agent):
    """One policy for all vehicles."""

    class Config(NetworkSettings):
        """Hyperparameters."""

        learning_rate: LearningRate = 5e-3
        """Adam's step size."""

    def __init__(self, env, utility, **options):
        super().__init__(env, utility, **options)
        self.units = torch.tensor([*self.env.observation_scales, *self.env.objective_scales])
        shape = len(self.units), self.env.actions
        self.actor = make_actor(self.config, *shape, self.initial, continuous=self.env.continuous)
        self.learner = Learner([Networks(actor=self.actor)], max_grad_norm=math.inf, name=self.name)
        self.learners = [self.learner]

    def inputs(self, observations, accrued):
        return torch.cat([torch.as_tensor(observations), torch.as_tensor(accrued)], dim=-1) / self.units

    @torch.inference_mode()
    def act(self, observations, accrued_reward, generator):
        return self.actor.act(self.inputs(observations, accrued_reward.value), generator).numpy()

    def update(self, progress):
        env, n, v = self.env, self.env.num_envs, self.env.vehicles
        observations, past = env.reset(self.env_seed + n * self.updates), AccruedReward.begin(n, v, len(env.objectives))
        running, arrived, taken = np.ones((n, v), bool), np.zeros((n, v), bool), []
        for _ in env.decisions():
            actions = self.act(observations, past, self.generator)
            taken.append((observations, past.value.copy(), actions, running))
            step = env.step(actions)
            past.add(step.rewards * running[..., None], 1.0)
            arrived |= step.succeeded & running
            running = running & ~(step.terminated | step.truncated)
            if not running.any():  # until then the other environments have begun further episodes
                break
            observations = step.observations
        self.step += len(taken) * n
        self.updates += 1

        columns = zip(*taken, strict=True)
        observations, accrued, actions, running = (torch.from_numpy(np.stack(each))[None] for each in columns)
        returns = torch.from_numpy(past.value)[None]  # (1, N, V, d), where 1 is the number of seeds
        utilities = torch.stack([u(returns[:, :, i]) for i, u in enumerate(self.utilities)], dim=-1)
        values = (utilities - utilities.mean(1)) / (utilities.std(1, correction=0) + 1e-8)
        samples = {"inputs": self.inputs(observations, accrued), "actions": actions, "values": running * values}
        sums = [torch.from_numpy(arrived)[None], running.sum(1), *returns.unbind(-1)]
        self.episodes.add(torch.ones(1, n, v, dtype=torch.bool), torch.stack(sums, dim=-1).double())
        return self.learner.minimise(self.loss, samples, [], torch.tensor(self.config.learning_rate))

    def loss(self, networks, samples):  # of one seed
        log_prob, _ = networks.actor(samples["inputs"], samples["actions"])
        loss = -(samples["values"] * log_prob).sum(0).mean()
        return Loss(loss, {POLICY_LOSS: loss})

    def get_state(self):
        return self.learner.get_state()

    def set_state(self, state):
        self.learner.set_state(state)
