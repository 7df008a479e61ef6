"""Trainers for multi-objective environments with a known utility."""

from algorithms.a2c import A2C
from algorithms.base import ActorCritic
from algorithms.mo_a2c import MOA2C
from algorithms.mo_ppo import MOPPO

ALGORITHMS: dict[str, type[ActorCritic]] = {algorithm.name: algorithm for algorithm in (A2C, MOA2C, MOPPO)}

__all__ = ["A2C", "ALGORITHMS", "MOA2C", "MOPPO", "ActorCritic"]
