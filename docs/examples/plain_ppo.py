"""PPO (Schulman et al. 2017) in plain PyTorch, for the unprotected left turn."""

import gymnasium
import torch
from torch import nn

from mo_deepdrive.wrappers import VectorUtilityReward

ENV_ID, UTILITY = "mo_deepdrive:mo-deepdrive-left-turn-v0", "left_turn_linear"
ENVS, STEPS, EPOCHS, MINIBATCHES, CLIP, LAMBDA = 512, 32, 4, 4, 0.2, 0.98
GAMMA = 0.9995  # an episode lasts hundreds of decisions
RATE, ENTROPY = (1e-3, 1e-5), (0.03, 0.0003)  # at the start and at the end
RETURN_SCALE = 10.0  # nominal return, in units of which the critic learns


def network(inputs, outputs):
    return nn.Sequential(
        *(nn.Linear(inputs, 128), nn.ReLU(), nn.Linear(128, 64), nn.ReLU(), nn.Linear(64, outputs)),
    )


def train(total_timesteps=10_000_000, seed=0):
    """Return a policy, a function of observations, accrued rewards and discounts."""
    torch.manual_seed(seed)
    envs = gymnasium.make_vec(ENV_ID, num_envs=ENVS, autoreset_mode="SameStep")
    scales = torch.as_tensor(envs.unwrapped.observation_scales)  # SI units differ a hundredfold
    envs = VectorUtilityReward(envs, UTILITY)
    actor, critic = network(len(scales), int(envs.single_action_space.n)), network(len(scales), 1)
    parameters = [*actor.parameters(), *critic.parameters()]
    optimiser = torch.optim.Adam(parameters)
    observations, _ = envs.reset(seed=2**32 + seed * 2**20)  # scenarios of the train split
    updates = total_timesteps // (ENVS * STEPS)
    for update in range(updates):
        rate, entropy_cost = (a * (b / a) ** (update / updates) for a, b in (RATE, ENTROPY))
        rows = []
        for _ in range(STEPS):
            seen = torch.as_tensor(observations) / scales
            with torch.no_grad():
                actions = torch.distributions.Categorical(logits=actor(seen)).sample()
            observations, rewards, terminated, truncated, infos = envs.step(actions.numpy())
            following = observations.copy()  # where an episode has ended, its last observation
            for i in (terminated | truncated).nonzero()[0]:
                following[i] = infos["final_obs"][i]
            rows.append([seen, actions, torch.as_tensor(following) / scales, *map(torch.as_tensor, (rewards, terminated, truncated))])
        seen, actions, following, rewards, terminated, truncated = map(torch.stack, zip(*rows, strict=True))
        with torch.no_grad():
            log_old = torch.distributions.Categorical(logits=actor(seen)).log_prob(actions)
            values, next_values = (RETURN_SCALE * critic(x).squeeze(-1) for x in (seen, following))
        # A time limit is not an end of the task: only termination has no value.
        deltas = rewards.float() + GAMMA * next_values * ~terminated - values
        advantages, advantage = torch.zeros_like(deltas), torch.zeros(ENVS)
        for t in reversed(range(STEPS)):
            advantage = deltas[t] + GAMMA * LAMBDA * advantage * ~(terminated | truncated)[t]
            advantages[t] = advantage
        targets = (values + advantages) / RETURN_SCALE
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        samples = [x.flatten(0, 1) for x in (seen, actions, log_old, advantages, targets)]
        for batch in (b for _ in range(EPOCHS) for b in torch.randperm(ENVS * STEPS).chunk(MINIBATCHES)):
            x, a, old, advantage, target = (each[batch] for each in samples)
            policy = torch.distributions.Categorical(logits=actor(x))
            ratio = (policy.log_prob(a) - old).exp()
            surrogate = torch.min(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage).mean()
            loss = -surrogate + 0.5 * (critic(x).squeeze(-1) - target).square().mean() - entropy_cost * policy.entropy().mean()
            optimiser.param_groups[0]["lr"] = rate
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, 0.5)
            optimiser.step()

    @torch.no_grad()
    def policy(observations, _accrued, _discounts):
        return torch.distributions.Categorical(logits=actor(torch.as_tensor(observations) / scales)).sample().numpy()

    return policy
