"""MO-PPO: proximal policy optimisation with MO-A2C's vector critic and advantages, for a known utility.

Critic, augmented state and advantages are those of :mod:`algorithms.mo_a2c`, the clipped steps those of
:mod:`algorithms.ppo`.
"""

from __future__ import annotations

from algorithms.actor_critic import ActorCritic
from algorithms.mo_a2c import MOA2CConfig, MOA2CLearner
from algorithms.ppo import ClippedConfig, ClippedLearner


class MOPPOConfig(ClippedConfig, MOA2CConfig):
    """Hyperparameters of MO-PPO: those of MO-A2C and of the clipped steps."""


class MOPPOLearner(ClippedLearner, MOA2CLearner):
    """Clipped steps with a vector critic on the augmented state."""

    config: MOPPOConfig


class MOPPO(ActorCritic):
    """Multi-objective proximal policy optimisation for a known utility."""

    name = "mo_ppo"
    Config = MOPPOConfig
    learner = MOPPOLearner
