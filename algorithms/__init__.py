"""Trainers for multi-objective environments with a known utility."""

from algorithms.a2c import A2C
from algorithms.base import ActorCritic
from algorithms.mo_a2c import MOA2C

ALGORITHMS: dict[str, type[ActorCritic]] = {algorithm.name: algorithm for algorithm in (A2C, MOA2C)}

__all__ = ["A2C", "ALGORITHMS", "MOA2C", "ActorCritic"]
