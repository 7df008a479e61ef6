"""Two PPO learners of RLlib at the intersection, one policy per vehicle, scored on the test split."""

import csv
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from rllib_vector_runner import VectorRunner

from mo_deepdrive.envs.rllib import DrivingMultiAgentEnv
from mo_deepdrive.evaluation import evaluate
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES
from mo_deepdrive.world.observation import scales
from mo_deepdrive.world.scenarios import SCENARIOS

ENV_ID, UTILITY = "mo-deepdrive-intersection-v1", "intersection_linear"
VEHICLES = ("vehicle_0", "vehicle_1")
WORLDS, DECISIONS = 256, 32  # in parallel, and of each between two updates
VALUE_SCALE = 10.0  # nominal size of a return


class DrivingModule(TorchRLModule, ValueFunctionAPI):
    """Actor and critic of one vehicle, which share nothing; both see observations divided by nominal magnitudes."""

    def setup(self):
        self.scales = torch.as_tensor(scales(SCENARIOS["intersection"]), dtype=torch.float32)
        self.actor = perceptron(len(self.scales), int(self.action_space.n), gain=0.01)
        self.critic = perceptron(len(self.scales), 1, gain=1.0)

    def _forward(self, batch, **kwargs):
        return {Columns.ACTION_DIST_INPUTS: self.actor(batch[Columns.OBS] / self.scales)}

    def compute_values(self, batch, embeddings=None):
        return VALUE_SCALE * self.critic(batch[Columns.OBS] / self.scales).squeeze(-1)


def perceptron(inputs, outputs, gain):
    """Two hidden layers, orthogonally initialised."""
    layers = [torch.nn.Linear(*sizes) for sizes in ((inputs, 128), (128, 64), (64, outputs))]
    for layer, scale in zip(layers, (2**0.5, 2**0.5, gain), strict=True):
        torch.nn.init.orthogonal_(layer.weight, scale)
        torch.nn.init.zeros_(layer.bias)
    return torch.nn.Sequential(layers[0], torch.nn.ReLU(), layers[1], torch.nn.ReLU(), layers[2])


class GrowingCosts(ConnectorV2):
    """Learn from the utility of the vectors in ``infos``, with costs that grow from 0 to their full size.

    A vehicle that has to pay for every failed turn from the beginning may learn to stand still.
    """

    def __init__(self, observation_space=None, action_space=None, *, until):
        super().__init__(observation_space, action_space)
        objectives = gymnasium.spec(ENV_ID).kwargs["objectives"]
        self.utility = make_utility(UTILITY, objectives)
        self.is_cost = np.array([OBJECTIVES[INDEX[name]].sign < 0 for name in objectives])
        self.until = until
        self.steps = 0

    def __call__(self, *, batch, episodes, **kwargs):
        factors = np.where(self.is_cost, min(1.0, self.steps / self.until), 1.0)
        for episode in self.single_agent_episode_iterator(episodes, agents_that_stepped_only=False):
            vectors = np.stack([info["vector_reward"] for info in episode.get_infos(slice(1, None))])
            rewards = self.utility(vectors * factors)
            self.add_n_batch_items(batch, Columns.REWARDS, rewards, len(episode), episode)
        self.steps += sum(map(len, episodes))
        return batch


def make_config(total_timesteps, seed):
    """Settings of configs/intersection/ppo_linear_tuned.yaml, as far as RLlib has them."""
    # RLlib's schedules are linear between points; these follow a geometric decay from 0.03 to 0.001.
    entropy = [[int(x * total_timesteps), 0.03 * (0.001 / 0.03) ** x] for x in np.linspace(0, 1, 11)]
    return (
        PPOConfig()
        .environment(DrivingMultiAgentEnv, env_config={"utility": UTILITY})
        .multi_agent(policies=set(VEHICLES), policy_mapping_fn=lambda agent, *_, **__: agent)
        .rl_module(
            rl_module_spec=MultiRLModuleSpec(
                rl_module_specs={vehicle: RLModuleSpec(module_class=DrivingModule) for vehicle in VEHICLES}
            )
        )
        .env_runners(
            env_runner_cls=VectorRunner,
            num_env_runners=0,
            num_envs_per_env_runner=WORLDS,
            rollout_fragment_length=DECISIONS,
        )
        .learners(learner_connector=lambda *spaces: GrowingCosts(*spaces, until=total_timesteps / 4))
        .training(
            lr=[[0, 1e-3], [total_timesteps, 1e-5]],
            gamma=0.998,
            lambda_=0.95,
            train_batch_size_per_learner=WORLDS * DECISIONS,
            minibatch_size=WORLDS * DECISIONS // 4,
            num_epochs=4,
            clip_param=0.2,
            entropy_coeff=entropy,
            vf_loss_coeff=0.5 / VALUE_SCALE**2,
            vf_clip_param=float("inf"),
            use_kl_loss=False,
            grad_clip=0.5,
            grad_clip_by="global_norm",
        )
        .debugging(seed=seed)
    )


def score(algorithm, split, episodes, greedy):
    """Shares of arrivals and collisions, and mean utilities, of all episodes of a split."""
    modules = [algorithm.get_module(vehicle) for vehicle in VEHICLES]
    generator = torch.Generator().manual_seed(0)

    @torch.no_grad()
    def policy(observations, _accrued, _discounts):
        seen = torch.as_tensor(observations)
        logits = [
            module.forward_inference({Columns.OBS: seen[:, v]})[Columns.ACTION_DIST_INPUTS]
            for v, module in enumerate(modules)
        ]
        if greedy:
            return torch.stack([each.argmax(-1) for each in logits], dim=1).numpy()
        return torch.cat([torch.multinomial(each.softmax(-1), 1, generator=generator) for each in logits], 1).numpy()

    evaluation = evaluate(policy, ENV_ID, split=split, episodes=episodes, utility=UTILITY)
    scores = {
        "actions": "greedy" if greedy else "sampled",
        "both_arrive": evaluation.succeeded.all(axis=1).mean(),
        "collisions": (evaluation.ends == "collision").any(axis=1).mean(),
    }
    for v, vehicle in enumerate(VEHICLES):
        scores[f"{vehicle}_arrives"] = evaluation.succeeded[:, v].mean()
        scores[f"{vehicle}_collides"] = (evaluation.ends[:, v] == "collision").mean()
        scores[f"{vehicle}_utility"] = evaluation.episode_utilities(v).mean()
    return {name: value if isinstance(value, str) else round(float(value), 4) for name, value in scores.items()}


def write(path, rows):
    """A table of dicts with the same keys."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def main(output="runs/rllib", total_timesteps=4_000_000, seed=0, episodes=1000, evaluations=20):
    """Train, writing ``curve.csv`` (200 validation scenarios a time); then ``scores.csv``, on the test split."""
    torch.set_num_threads(1)
    algorithm = make_config(total_timesteps, seed).build_algo()
    curve, steps, seconds = [], 0, 0.0
    while steps < total_timesteps:
        begin = time.process_time()
        result = algorithm.train()
        seconds += time.process_time() - begin
        steps = int(result["env_runners"]["num_env_steps_sampled_lifetime"])
        if steps >= (len(curve) // 2 + 1) * total_timesteps / evaluations:
            for greedy in (False, True):
                scores = score(algorithm, "validation", min(episodes, 200), greedy)
                curve.append({"joint_steps": steps, "cpu_seconds": round(seconds, 1), **scores})
            print(curve[-2])
            write(Path(output) / "curve.csv", curve)
    scores = [score(algorithm, "test", episodes, greedy) for greedy in (False, True)]
    write(Path(output) / "scores.csv", scores)
    print(*scores, sep="\n")
    algorithm.stop()
    return scores


if __name__ == "__main__":
    main()
