"""RLlib's PPO at the roundabout: eight vehicles that learn one policy and all drive by it."""

import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule

from mo_deepdrive.envs.rllib import DrivingMultiAgentEnv
from mo_deepdrive.evaluation import evaluate
from mo_deepdrive.world.observation import scales
from mo_deepdrive.world.scenarios import SCENARIOS

VEHICLES, UTILITY = 8, "roundabout_linear"


class Driver(TorchRLModule, ValueFunctionAPI):
    """Actor and critic, which see observations divided by their nominal magnitudes."""

    def setup(self):
        self.scales = torch.as_tensor(scales(SCENARIOS["roundabout"]), dtype=torch.float32)
        self.actor = perceptron(len(self.scales), int(self.action_space.n))
        self.critic = perceptron(len(self.scales), 1)

    def _forward(self, batch, **kwargs):
        return {Columns.ACTION_DIST_INPUTS: self.actor(batch[Columns.OBS] / self.scales)}

    def compute_values(self, batch, embeddings=None):
        return self.critic(batch[Columns.OBS] / self.scales).squeeze(-1)


def perceptron(inputs, outputs):
    """Two hidden layers."""
    sizes = (inputs, 128), (128, 128)
    hidden = [layer for size in sizes for layer in (torch.nn.Linear(*size), torch.nn.Tanh())]
    return torch.nn.Sequential(*hidden, torch.nn.Linear(128, outputs))


def make_config(worlds=16, decisions=128):
    """PPO in ``worlds`` roundabouts at once, with ``decisions`` in each between two updates."""
    return (
        PPOConfig()
        .environment(
            DrivingMultiAgentEnv, env_config={"scenario": "roundabout", "vehicles": VEHICLES, "utility": UTILITY}
        )
        .multi_agent(policies={"shared"}, policy_mapping_fn=lambda *_, **__: "shared")
        .rl_module(rl_module_spec=RLModuleSpec(module_class=Driver))
        .env_runners(num_env_runners=0, num_envs_per_env_runner=worlds, rollout_fragment_length=decisions)
        .training(
            lr=3e-4,
            gamma=0.99,
            lambda_=0.95,
            train_batch_size_per_learner=worlds * decisions,
            minibatch_size=worlds * decisions,  # a batch has as many decisions of each vehicle
            num_epochs=4,
            entropy_coeff=0.01,
            use_kl_loss=False,
            vf_clip_param=float("inf"),
        )
        .debugging(seed=0)
    )


def main(updates=100, episodes=100, **sizes):
    """Train, and score the policy on the test split."""
    algorithm = make_config(**sizes).build_algo()
    for update in range(updates):
        sampled = algorithm.train()["env_runners"]
        if update % 10 == 0 and "episode_return_mean" in sampled:
            print(f"update {update}: utility of all vehicles together {sampled['episode_return_mean']:.1f}")
    module = algorithm.get_module("shared")

    @torch.no_grad()
    def policy(observations, _accrued, _discounts):
        logits = module.forward_inference({Columns.OBS: torch.as_tensor(observations)})[Columns.ACTION_DIST_INPUTS]
        return logits.argmax(-1).numpy()  # (environments, vehicles)

    evaluation = evaluate(
        policy,
        "mo-deepdrive-roundabout-v0",
        env_kwargs={"vehicles": VEHICLES},
        split="test",
        episodes=episodes,
        utility=UTILITY,
    )
    algorithm.stop()
    estimates = evaluation.estimates()
    for name in ("total_utility_esr", "worst_off_utility_esr", "success"):  # of the vehicles together; all arrive
        print(name, estimates[name].text())
    print("share of the vehicles that arrive", evaluation.succeeded.mean())
    return evaluation


if __name__ == "__main__":
    main()
