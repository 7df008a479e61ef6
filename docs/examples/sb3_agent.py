"""PPO of Stable-Baselines3, trained for task K1 of the suite and scored on the test split."""

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from torch.nn import ReLU

import mo_deepdrive  # noqa: F401  (registers the ids)
from mo_deepdrive.envs.sb3 import SB3VecEnv
from mo_deepdrive.evaluation import evaluate
from mo_deepdrive.evaluation.splits import FIRST_TRAINING_SEED
from mo_deepdrive.wrappers import VectorScaledObservation, VectorUtilityReward

ENV_ID, UTILITY = "mo-deepdrive-static-obstacle-v1", "static_obstacle_linear"


def main(total_timesteps=3_000_000, episodes=1000):
    """Train, evaluate, and print the metrics with their 95% intervals."""
    envs = gymnasium.make_vec(ENV_ID, num_envs=256, autoreset_mode="SameStep")
    envs = VectorScaledObservation(VectorUtilityReward(envs, UTILITY))
    model = PPO(
        "MlpPolicy",
        VecNormalize(VecMonitor(SB3VecEnv(envs)), norm_obs=False),
        n_steps=32,
        batch_size=2048,
        n_epochs=4,
        learning_rate=lambda remaining: 1e-3 * remaining,
        ent_coef=0.003,
        policy_kwargs={"net_arch": [128, 64], "activation_fn": ReLU},
        seed=0,
        device="cpu",
    )
    model.env.seed(FIRST_TRAINING_SEED)  # scenarios that no evaluation has
    model.learn(total_timesteps)

    def policy(observations, _accrued, _discounts):
        return model.predict(observations / envs.scales)[0]

    evaluation = evaluate(policy, ENV_ID, split="test", episodes=episodes, utility=UTILITY)
    for name, estimate in evaluation.estimates().items():
        print(f"{name:28} {estimate.text()}")
    return evaluation


if __name__ == "__main__":
    main()
