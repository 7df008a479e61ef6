"""PPO in TorchRL, trained on the utility of the reward and scored on the test split."""

import mo_gymnasium
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, GymWrapper, ObservationNorm, TransformedEnv, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from mo_deepdrive.evaluation import evaluate
from mo_deepdrive.world.observation import scales
from mo_deepdrive.world.scenarios import SCENARIOS
from mo_deepdrive.wrappers import UtilityReward

ENV_ID, UTILITY = "mo-deepdrive-one-waypoint-v1", "one_waypoint_linear"
SCALE = 1 / torch.as_tensor(scales(SCENARIOS["one_waypoint"]), dtype=torch.float32)  # nominal magnitudes


def make_env():
    """A TorchRL environment with a scalar reward and scaled observations."""
    env = GymWrapper(UtilityReward(mo_gymnasium.make(ENV_ID), UTILITY), categorical_action_encoding=True)
    return TransformedEnv(env, ObservationNorm(loc=torch.zeros(15), scale=SCALE, in_keys=["observation"]))


def main(total_timesteps=60_000, episodes=1000):
    """Train, evaluate, and print the metrics with their 95% intervals."""
    torch.manual_seed(0)  # noqa: TID251  (TorchRL samples from the global generator)
    env = make_env()
    env.set_seed(0)
    sizes = {"in_features": 15, "num_cells": [64, 64], "activation_class": torch.nn.Tanh}
    actor = ProbabilisticActor(
        TensorDictModule(MLP(out_features=22, **sizes), in_keys=["observation"], out_keys=["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(out_features=1, **sizes), in_keys=["observation"])
    loss_of = ClipPPOLoss(actor, critic, entropy_coeff=0.003)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
    optimiser = torch.optim.Adam(loss_of.parameters(), lr=3e-4)
    for rollout in Collector(env, actor, frames_per_batch=2048, total_frames=total_timesteps):
        for _ in range(10):
            advantage(rollout)
            for rows in torch.randperm(len(rollout)).split(64):
                losses = loss_of(rollout[rows])
                loss = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
                optimiser.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(loss_of.parameters(), 0.5)
                optimiser.step()

    @torch.no_grad()
    def policy(observations, _accrued, _discounts):
        inputs = TensorDict({"observation": torch.as_tensor(observations) * SCALE}, len(observations))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return actor(inputs)["action"].numpy()

    evaluation = evaluate(policy, ENV_ID, split="test", episodes=episodes, utility=UTILITY)
    for name, estimate in evaluation.estimates().items():
        print(f"{name:28} {estimate.text()}")
    return evaluation


if __name__ == "__main__":
    main()
