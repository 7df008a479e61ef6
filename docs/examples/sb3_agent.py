"""PPO of Stable-Baselines3, trained on the utility of the reward and scored on the test split."""

import mo_gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from mo_deepdrive.evaluation import evaluate
from mo_deepdrive.wrappers import UtilityReward

ENV_ID, UTILITY = "mo-deepdrive-one-waypoint-v0", "one_waypoint_linear"


def make_env():
    """A single environment with a scalar reward."""
    return UtilityReward(mo_gymnasium.make(ENV_ID), UTILITY)


def main(total_timesteps=100_000, episodes=1000):
    """Train, evaluate, and print the metrics with their 95% intervals."""
    envs = VecNormalize(make_vec_env(make_env, n_envs=8, seed=0), norm_reward=False)
    model = PPO("MlpPolicy", envs, n_steps=256, batch_size=256, seed=0, device="cpu").learn(total_timesteps)

    def policy(observations, _accrued, _discounts):
        return model.predict(envs.normalize_obs(observations), deterministic=True)[0]

    evaluation = evaluate(policy, ENV_ID, split="test", episodes=episodes, utility=UTILITY)
    for name, estimate in evaluation.estimates().items():
        print(f"{name:28} {estimate.text()}")
    return evaluation


if __name__ == "__main__":
    main()
