"""Two vehicles learn by PPO in plain PyTorch, through PettingZoo: ``python pettingzoo_ppo.py``."""

import numpy as np
import torch
from torch import nn
from torch.distributions import Categorical

import mo_deepdrive
from mo_deepdrive.wrappers import ParallelUtilityReward

EPISODES, EPOCHS, CLIP, GAMMA, ENTROPY, RETURN_SCALE = 16, 8, 0.2, 0.998, 0.01, 10.0
UTILITIES = {"vehicle_0": "intersection_hurried", "vehicle_1": "intersection_linear"}


def network(inputs, outputs):
    """Two hidden layers."""
    return nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))


class Learner:
    """The policy and the critic of one vehicle, which see neither the reward nor the policy of another."""

    def __init__(self, env, agent):
        inputs, actions = env.observation_space(agent).shape[0], int(env.action_space(agent).n)
        self.scales = torch.tensor(env.unwrapped.observation_scales, dtype=torch.float32)
        self.actor, self.critic = network(inputs, actions), network(inputs, 1)
        self.optimiser = torch.optim.Adam([*self.actor.parameters(), *self.critic.parameters()], lr=1e-3)

    @torch.no_grad()
    def act(self, observation):
        """Sample an action."""
        return int(Categorical(logits=self.actor(torch.from_numpy(observation) / self.scales)).sample())

    def learn(self, episodes):
        """One update, from the steps of every episode, its last observation, and whether it met the time limit."""
        observations, actions, targets = [], [], []
        for steps, last, truncated in episodes:
            with torch.no_grad():  # a time limit does not end the task
                value = float(RETURN_SCALE * self.critic(torch.from_numpy(last) / self.scales)) * truncated
            for observation, action, reward in reversed(steps):
                value = reward + GAMMA * value
                observations.append(observation)
                actions.append(action)
                targets.append(value / RETURN_SCALE)
        x = torch.from_numpy(np.stack(observations)) / self.scales
        actions, targets = torch.tensor(actions), torch.tensor(targets, dtype=torch.float32)
        with torch.no_grad():
            log_old = Categorical(logits=self.actor(x)).log_prob(actions)
            advantages = targets - self.critic(x).squeeze(-1)
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        for _ in range(EPOCHS):
            policy = Categorical(logits=self.actor(x))
            ratio = (policy.log_prob(actions) - log_old).exp()
            policy_loss = -torch.min(ratio * advantages, ratio.clamp(1 - CLIP, 1 + CLIP) * advantages).mean()
            value_loss = (self.critic(x).squeeze(-1) - targets).square().mean()
            self.optimiser.zero_grad()
            (policy_loss + 0.5 * value_loss - ENTROPY * policy.entropy().mean()).backward()
            self.optimiser.step()


def play(env, learners, seed):
    """One episode: for every vehicle what its learner takes, and why it ended."""
    observations, _ = env.reset(seed=seed)
    steps, episodes, ends = {agent: [] for agent in env.agents}, {}, {}
    while env.agents:
        actions = {agent: learners[agent].act(observations[agent]) for agent in env.agents}
        after, rewards, _, truncated, infos = env.step(actions)
        for agent, action in actions.items():
            steps[agent].append((observations[agent], action, rewards[agent]))
            if "end" in infos[agent]:  # this vehicle leaves, and the other one may go on
                episodes[agent] = steps[agent], after[agent], truncated[agent]
                ends[agent] = infos[agent]["end"]
        observations = after
    return episodes, ends


def train(updates, seed=0):
    """Train all vehicles; yields their learners, their mean utilities and their shares of arrivals."""
    torch.manual_seed(seed)
    env = ParallelUtilityReward(mo_deepdrive.parallel_env(), UTILITIES)  # of the intersection
    learners = {agent: Learner(env, agent) for agent in env.possible_agents}
    first = 2**32 + EPISODES * updates * seed  # scenarios of the train split
    for update in range(updates):
        seeds = range(first + EPISODES * update, first + EPISODES * (update + 1))
        played = [play(env, learners, each) for each in seeds]
        for agent, learner in learners.items():
            learner.learn([episodes[agent] for episodes, _ in played])
        utilities = {a: sum(r for e, _ in played for _, _, r in e[a][0]) / EPISODES for a in learners}
        arrivals = {a: sum(ends[a] == "arrived" for _, ends in played) / EPISODES for a in learners}
        yield learners, utilities, arrivals


if __name__ == "__main__":
    for _, utilities, arrivals in train(updates=500):
        print(utilities, arrivals)
