"""The three splits of scenario seeds. No scenario is in two of them.

An environment that is reset with a seed draws its scenario from it. Training counts up from
:data:`FIRST_TRAINING_SEED` plus a 32-bit number that the run's seed determines. Evaluations count up from the first
seed of a split, one per episode:

- ``validation``: learning curves, and everything that is chosen by a score, such as hyperparameters or checkpoints.
- ``test``: final scores, which nothing is chosen by.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

Split = Literal["validation", "test"]

SPLITS: Mapping[Split, range] = {"validation": range(2_000_000, 3_000_000), "test": range(3_000_000, 3_002_000)}
FIRST_TRAINING_SEED = 2**32
# A seed that a user gives for an evaluation stays below it, so that counting up does not reach the training seeds.
EVALUATION_SEED_LIMIT = 2**31


def check_episodes(name: str, episodes: int, split: Split) -> None:
    """Refuse more ``episodes``, which ``name`` sets, than a split has scenarios."""
    if episodes > len(SPLITS[split]):
        raise ValueError(f"{name} = {episodes} exceeds the {len(SPLITS[split]):,} scenarios of the {split} split")


def first_seed(split: Split | None, seed: int | None, episodes: int) -> int:
    """The seed of the first of ``episodes`` episodes: that of a split (default: "validation"), or a given one.

    Raises:
        ValueError: for an unknown split, one that is too small, a split and a seed, or a seed from which episodes would
            reach those of training.
    """
    if seed is not None:
        if split is not None:
            raise ValueError(f"split = {split!r} and seed = {seed!r} are both given; give one of them")
        if not 0 <= seed <= EVALUATION_SEED_LIMIT - episodes:
            raise ValueError(
                f"seed = {seed} must be from 0 to {EVALUATION_SEED_LIMIT - episodes}: "
                f"that of the first of {episodes} episodes, below the seeds of training"
            )
        return seed
    split = "validation" if split is None else split
    if split not in SPLITS:
        raise ValueError(f"split = {split!r} must be one of {list(SPLITS)}")
    check_episodes("episodes", episodes, split)
    return SPLITS[split].start


def split_of(seed: int, episodes: int) -> Split | None:
    """The split of which the first ``episodes`` scenarios begin at ``seed``; None for another seed."""
    names = (split for split, seeds in SPLITS.items() if seed == seeds.start and episodes <= len(seeds))
    return next(names, None)


def describe_episodes(episodes: int, seed: int) -> str:
    """The episodes of an evaluation as text, for example "1000 episodes of the test split"."""
    split = split_of(seed, episodes)
    return f"{episodes} episodes from seed {seed}" if split is None else f"{episodes} episodes of the {split} split"
