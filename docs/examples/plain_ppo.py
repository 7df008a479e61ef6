"""PPO (Schulman et al. 2017) in plain PyTorch, for the unprotected left turn."""

import gymnasium
import torch
from torch import nn
from torch.distributions import Categorical

from mo_deepdrive.wrappers import VectorScaledObservation, VectorUtilityReward

ENV_ID, UTILITY = "mo_deepdrive:mo-deepdrive-left-turn-v0", "left_turn_linear"
ENVS, STEPS, EPOCHS, MINIBATCHES, CLIP = 512, 32, 4, 4, 0.2
GAMMA, LAMBDA = 0.9995, 0.98  # an episode lasts hundreds of decisions
ENTROPY = 0.03, 0.0003  # its coefficient at the start and at the end
RETURN_SCALE = 10.0  # a nominal return, in units of which the critic learns


def network(inputs, outputs):
    """Two hidden layers."""
    return nn.Sequential(*(nn.Linear(inputs, 128), nn.ReLU(), nn.Linear(128, 64), nn.ReLU(), nn.Linear(64, outputs)))


def train(total_timesteps=10_000_000, seed=0):
    """Return a policy that samples: a function of observations, accrued rewards and discounts."""
    torch.manual_seed(seed)
    raw = gymnasium.make_vec(ENV_ID, num_envs=ENVS, autoreset_mode="SameStep")
    envs = VectorScaledObservation(VectorUtilityReward(raw, UTILITY))
    inputs, actions = envs.single_observation_space.shape[0], int(envs.single_action_space.n)
    actor, critic = network(inputs, actions), network(inputs, 1)
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()])
    observations, _ = envs.reset(seed=2**32 + ENVS * seed)  # scenarios of the train split
    updates = total_timesteps // (ENVS * STEPS)
    for update in range(updates):
        optimiser.param_groups[0]["lr"] = 1e-3 * (1 - update / updates)
        entropy_cost = ENTROPY[0] * (ENTROPY[1] / ENTROPY[0]) ** (update / updates)
        steps = []
        for _ in range(STEPS):
            x = torch.as_tensor(observations)
            with torch.no_grad():
                a = Categorical(logits=actor(x)).sample()
            observations, rewards, terminated, truncated, infos = envs.step(a.numpy())
            after = infos.get("final_obs", observations)  # of this episode, not of the next one
            steps.append([x, a, *map(torch.as_tensor, (after, rewards, terminated, terminated | truncated))])
        x, a, after, rewards, terminated, over = map(torch.stack, zip(*steps, strict=True))

        with torch.no_grad():
            log_old = Categorical(logits=actor(x)).log_prob(a)
            values, next_values = (RETURN_SCALE * critic(each).squeeze(-1) for each in (x, after))
        # A time limit does not end the task, so the value of what would follow counts.
        deltas = rewards.float() + GAMMA * next_values * ~terminated - values
        advantages = torch.zeros_like(deltas)
        for t in reversed(range(STEPS)):
            following = advantages[t + 1] if t + 1 < STEPS else 0.0
            advantages[t] = deltas[t] + GAMMA * LAMBDA * following * ~over[t]
        targets = (values + advantages) / RETURN_SCALE
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)

        samples = [each.flatten(0, 1) for each in (x, a, log_old, advantages, targets)]
        for _ in range(EPOCHS):
            for rows in torch.randperm(ENVS * STEPS).chunk(MINIBATCHES):
                x, a, log_old, advantages, targets = (each[rows] for each in samples)
                policy = Categorical(logits=actor(x))
                ratio = (policy.log_prob(a) - log_old).exp()
                clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
                policy_loss = -torch.min(ratio * advantages, clipped * advantages).mean()
                value_loss = (critic(x).squeeze(-1) - targets).square().mean()
                loss = policy_loss + 0.5 * value_loss - entropy_cost * policy.entropy().mean()
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(optimiser.param_groups[0]["params"], 0.5)
                optimiser.step()

    @torch.no_grad()
    def policy(observations, _accrued, _discounts):
        return Categorical(logits=actor(torch.as_tensor(observations / envs.scales))).sample().numpy()

    return policy
