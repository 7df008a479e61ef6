"""PPO (Schulman et al. 2017) in plain PyTorch, on a GPU if there is one: ``suite score plain_ppo.py --tasks K5``."""

import gymnasium
import torch
from torch import nn
from torch.distributions import Categorical

from mo_deepdrive import suite

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
ENVS, STEPS, EPOCHS, MINIBATCHES, CLIP = 512, 32, 4, 4, 0.2
GAMMA, LAMBDA = 0.9995, 0.98  # an episode lasts hundreds of decisions
ENTROPY = 0.03, 0.0003  # its coefficient at the start and at the end
RETURN_SCALE = 10.0  # a nominal return, in units of which the critic learns
# Of the rewards: prices of the task, which is averse to risk, so that a collision costs twice what an arrival gives.
WEIGHTS = {"distance": 0.3, "destination": 10, "collision": 20, "g_force": 0.03, "jerk": 0.0006, "time": 1.0}


def network(inputs, outputs):
    """Two hidden layers."""
    layers = nn.Linear(inputs, 128), nn.ReLU(), nn.Linear(128, 64), nn.ReLU(), nn.Linear(64, outputs)
    return nn.Sequential(*layers).to(DEVICE)


class Policy:
    """Trains for a task of the suite with one vehicle and discrete actions, and is its policy then."""

    def __init__(self, task_id, seed=0, total_timesteps=None):
        task = suite.load().task(task_id)
        torch.manual_seed(seed)
        settings = {"num_envs": ENVS, "autoreset_mode": "SameStep", "device": DEVICE, **task.environment.arguments}
        envs = gymnasium.make_vec(task.environment.id, **settings)
        weights = torch.tensor([WEIGHTS.get(name, 0.0) for name in envs.unwrapped.objectives], device=DEVICE)
        self.scales = torch.tensor(envs.unwrapped.observation_scales, dtype=torch.float32, device=DEVICE)
        inputs, actions = envs.single_observation_space.shape[0], int(envs.single_action_space.n)
        self.actor, self.critic = network(inputs, actions), network(inputs, 1)
        self.optimiser = torch.optim.Adam([*self.actor.parameters(), *self.critic.parameters()])
        observations, _ = envs.reset(seed=seed)  # draws scenarios on the device, which are in no split
        updates = (total_timesteps or task.steps) // (ENVS * STEPS)
        for update in range(updates):
            self.optimiser.param_groups[0]["lr"] = 1e-3 * (1 - update / updates)
            steps = []
            for _ in range(STEPS):
                x = observations / self.scales
                actions = self.act(x)
                observations, rewards, terminated, truncated, infos = envs.step(actions)
                after = infos["final_obs"] / self.scales  # of this episode, not of the next one
                steps.append((actions, x, after, rewards @ weights, terminated, terminated | truncated))
            entropy_cost = ENTROPY[0] * (ENTROPY[1] / ENTROPY[0]) ** (update / updates)
            self.learn(*map(torch.stack, zip(*steps, strict=True)), entropy_cost)

    @torch.no_grad()
    def act(self, x):
        """Sample actions."""
        return Categorical(logits=self.actor(x)).sample()

    def learn(self, actions, x, after, rewards, terminated, over, entropy_cost):
        """One update, from T steps of N environments."""
        with torch.no_grad():
            log_old = Categorical(logits=self.actor(x)).log_prob(actions)
            values, next_values = (RETURN_SCALE * self.critic(each).squeeze(-1) for each in (x, after))
        # A time limit does not end the task, so the value of what would follow counts.
        deltas = rewards + GAMMA * next_values * ~terminated - values
        advantages = torch.zeros_like(deltas)
        for t in reversed(range(STEPS)):
            following = advantages[t + 1] if t + 1 < STEPS else 0.0
            advantages[t] = deltas[t] + GAMMA * LAMBDA * following * ~over[t]
        targets = (values + advantages) / RETURN_SCALE
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        samples = [each.flatten(0, 1) for each in (x, actions, log_old, advantages, targets)]
        order = [torch.randperm(ENVS * STEPS, device=DEVICE) for _ in range(EPOCHS)]
        for rows in (rows for epoch in order for rows in epoch.chunk(MINIBATCHES)):
            x, actions, log_old, advantages, targets = (each[rows] for each in samples)
            policy = Categorical(logits=self.actor(x))
            ratio = (policy.log_prob(actions) - log_old).exp()
            clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
            policy_loss = -torch.min(ratio * advantages, clipped * advantages).mean()
            value_loss = (self.critic(x).squeeze(-1) - targets).square().mean()
            self.optimiser.zero_grad()
            (policy_loss + 0.5 * value_loss - entropy_cost * policy.entropy().mean()).backward()
            nn.utils.clip_grad_norm_(self.optimiser.param_groups[0]["params"], 0.5)
            self.optimiser.step()

    def __call__(self, observations, _accrued, _discounts):
        """Actions (N,) for observations (N, o) of the environment."""
        return self.act(torch.as_tensor(observations, device=DEVICE) / self.scales).cpu().numpy()
