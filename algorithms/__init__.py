"""Trainers for multi-objective environments, for a known utility or for all."""

from typing import Any

from algorithms.a2c import A2C
from algorithms.actor_critic import ActorCritic
from algorithms.agent import Agent
from algorithms.mo_a2c import MOA2C
from algorithms.mo_ppo import MOPPO
from algorithms.pcn import PCN
from algorithms.ppo import PPO

ALGORITHMS: dict[str, type[Any]] = {algorithm.name: algorithm for algorithm in (A2C, PPO, MOA2C, MOPPO, PCN)}

__all__ = ["A2C", "ALGORITHMS", "MOA2C", "MOPPO", "PCN", "PPO", "ActorCritic", "Agent"]
