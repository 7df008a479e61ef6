"""Which seeds of scenarios are for training and which for evaluation: no scenario is in both.

An environment that is reset with a seed draws its scenario from it. Evaluations, during training and at its end, count
up from a small seed, one per episode; training counts up from :data:`FIRST_TRAINING_SEED` plus a 32-bit number that the
run's seed determines.
"""

from __future__ import annotations

# Seeds below it are for evaluation, from it on for training.
FIRST_TRAINING_SEED = 2**32
# Of the first episode of an evaluation, where the experiment does not set another one.
FIRST_EVALUATION_SEED = 1_000_000
# What an experiment may set stays below it, so that counting up over the episodes does not reach the training seeds.
EVALUATION_SEED_LIMIT = 2**31
