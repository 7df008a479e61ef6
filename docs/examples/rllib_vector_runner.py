"""An environment runner for RLlib that moves many worlds with one call."""

import uuid
from itertools import pairwise

import numpy as np
import torch
from gymnasium.spaces import Dict
from gymnasium.vector import AutoresetMode
from ray.rllib.core.columns import Columns
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer
from ray.rllib.utils.metrics import (
    NUM_ENV_STEPS_SAMPLED,
    NUM_ENV_STEPS_SAMPLED_LIFETIME,
    NUM_EPISODES,
    NUM_MODULE_STEPS_SAMPLED,
)

from mo_deepdrive.envs.rllib import DrivingMultiAgentEnv
from mo_deepdrive.envs.vector import DrivingVectorEnv


class VectorRunner(MultiAgentEnvRunner):
    """RLlib's multi-agent runner, with the native vector environment in the place of N separate ones.

    It takes the ``env_config`` of :class:`mo_deepdrive.envs.rllib.DrivingMultiAgentEnv` and returns the same episodes,
    but all worlds move in one compiled call, and a vehicle's observations pass its module as one batch. ``infos`` hold
    ``"vector_reward"`` alone. Env-to-module and module-to-env connectors, and callbacks on steps and episodes, are not
    called.
    """

    def make_env(self):
        self.num_envs = self.config.num_envs_per_env_runner
        self.env = DrivingMultiAgentEnv(self.config.env_config)  # for its spaces, objectives and utilities
        self.env.observation_space = self.env.single_observation_space = Dict(self.env.observation_spaces)
        self.env.action_space = self.env.single_action_space = Dict(self.env.action_spaces)
        options = self.env.parallel.config.model_dump()
        self.worlds = DrivingVectorEnv(self.num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **options)
        self._needs_initial_reset = True

    def sample(self, **_):
        """The next T decisions of every world, as one chunk for every episode in them."""
        if self._needs_initial_reset:
            self._observations, _ = self.worlds.reset(seed=self._seed)
            self._ids = [uuid.uuid4().hex for _ in range(self.num_envs)]
            self._ages = np.zeros(self.num_envs, dtype=int)  # decisions since the episode began
            self._needs_initial_reset = False
        decisions = [self._decide() for _ in range(self.config.get_rollout_fragment_length(self.worker_index))]
        rollout = {name: np.stack([decision[name] for decision in decisions]) for name in decisions[0]}
        chunks = [
            self._chunk(rollout, world, first, last)
            for world in range(self.num_envs)
            for first, last in spans(rollout["over"][:, world])
        ]
        self._log(chunks)
        return chunks

    @torch.no_grad()
    def _decide(self):
        """One decision in all worlds: arrays (N, V, ...), and whether each world's episode is over (N,)."""
        observations = self._observations
        outputs = []
        for v, agent in enumerate(self.env.possible_agents):
            module = self.module[agent]
            logits = module.forward_exploration({Columns.OBS: torch.from_numpy(observations[:, v])})[
                Columns.ACTION_DIST_INPUTS
            ]
            distribution = module.get_exploration_action_dist_cls().from_logits(logits)
            actions = distribution.sample()
            outputs.append((actions, distribution.logp(actions), logits))
        actions, log_prob, logits = (torch.stack(each, dim=1).numpy() for each in zip(*outputs, strict=True))
        self._observations, vectors, terminated, truncated, infos = self.worlds.step(actions)
        return {
            Columns.OBS: observations,
            Columns.ACTIONS: actions,
            Columns.ACTION_LOGP: log_prob,
            Columns.ACTION_DIST_INPUTS: logits,
            "vectors": vectors,
            "next": infos.get("final_obs", self._observations),
            "acted": infos["acted"],
            "terminated": terminated,
            "truncated": truncated,
            "over": infos.get("_final_obs", np.zeros(self.num_envs, dtype=bool)),
        }

    def _chunk(self, rollout, world, first, last):
        """The decisions ``first`` to ``last`` of a world, which belong to one episode, as RLlib keeps them."""
        over = rollout["over"][last - 1, world]
        chunk = MultiAgentEpisode(
            self._ids[world],
            env_t_started=self._ages[world],
            agent_to_module_mapping_fn=self.config.policy_mapping_fn,
        )
        chunk.env_t += last - first
        chunk.is_truncated = bool(over and rollout["truncated"][last - 1, world].any())
        chunk.is_terminated = bool(over and not chunk.is_truncated)
        for v, agent in enumerate(self.env.possible_agents):
            end = first + int(rollout["acted"][first:last, world, v].sum())  # a vehicle that has ended stays away
            if end == first:
                continue

            def own(name, end=end, v=v):
                return rollout[name][first:end, world, v]

            vectors = own("vectors")
            chunk.agent_episodes[agent] = SingleAgentEpisode(
                f"{chunk.id_}_{agent}",
                agent_id=agent,
                module_id=chunk.module_for(agent),
                multi_agent_episode_id=chunk.id_,
                observations=np.concatenate([own(Columns.OBS), own("next")[-1:]]),
                infos=[{}, *({"vector_reward": vector} for vector in vectors)],
                actions=own(Columns.ACTIONS),
                rewards=self.env.utilities[agent](vectors),
                terminated=bool(own("terminated")[-1]),
                truncated=bool(own("truncated")[-1]),
                extra_model_outputs={name: own(name) for name in (Columns.ACTION_LOGP, Columns.ACTION_DIST_INPUTS)},
                t_started=self._ages[world],
                len_lookback_buffer=0,
            )
            away = [chunk.SKIP_ENV_TS_TAG] * (last - end)
            chunk.env_t_to_agent_t[agent] = InfiniteLookbackBuffer([*range(end - first + 1), *away])
        self._ages[world] = 0 if over else self._ages[world] + last - first
        if over:
            self._ids[world] = uuid.uuid4().hex
        return chunk

    def _log(self, chunks):
        """Steps and episodes under RLlib's names; RLlib logs the returns of the episodes itself."""
        steps = sum(len(chunk) for chunk in chunks)
        self.metrics.log_value(NUM_ENV_STEPS_SAMPLED, steps, reduce="sum")
        self.metrics.log_value(NUM_ENV_STEPS_SAMPLED_LIFETIME, steps, reduce="lifetime_sum", with_throughput=True)
        for chunk in chunks:
            for each in chunk.agent_episodes.values():
                self.metrics.log_value((NUM_MODULE_STEPS_SAMPLED, each.module_id), len(each), reduce="sum")
            if chunk.is_done:
                self.metrics.log_value(NUM_EPISODES, 1, reduce="sum")
                self._done_episodes_for_metrics.append(chunk)
            else:
                self._ongoing_episodes_for_metrics[chunk.id_].append(chunk)


def spans(over):
    """The pairs (first, last) between which no episode ends, last excluded, of T decisions of a world."""
    bounds = [0, *(np.flatnonzero(over) + 1), len(over)]
    return [(first, last) for first, last in pairwise(bounds) if last > first]
