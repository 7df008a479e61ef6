"""Variation: offspring plans by mutation and one-point crossover (Eiben and Smith 2015, chapter 4).

The unit of mutation is a segment: a maximal run of equal actions. A mutation lengthens, shortens, changes, inserts,
removes or rescales one. Plans are int16 arrays (decisions, k) of which the first ``length`` decisions count.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba

from mo_deepdrive.world.action_sequences import CONTINUOUS_UNIT

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

FULL_SCALE = round(1 / CONTINUOUS_UNIT)  # units of a continuous action of 1.0
CROSSOVER_RATE = 0.15
CONTINUE_RATE = 0.5  # probability of another mutation after each
RIPPLE_RATE = 0.4  # probability that a change of a segment's length moves what follows, instead of overwriting it


@numba.njit(cache=True)
def resize_segment(plan: NDArray[Any], length: int, first: int, last: int, room: int) -> int:
    """Make the decisions [first, last) of a plan ``room`` decisions long and move what follows them.

    The content of the new [first, first + room) is left for the caller to write.

    Returns:
        The plan's new length.
    """
    new = min(length + room - (last - first), len(plan))
    end = min(first + room, new)
    if end > last:
        for t in range(new - 1, end - 1, -1):
            plan[t] = plan[t - end + last]
    else:
        for t in range(end, new):
            plan[t] = plan[t - end + last]
    return new


@numba.njit(cache=True)
def random_duration(rng: np.random.Generator) -> int:
    """A random number of decisions: at least one, and mostly few."""
    return int(rng.geometric(0.35)) * (8 if rng.random() < 0.1 else 1)


@numba.njit(cache=True)
def mutate_action(action: NDArray[Any], n_actions: int, rng: np.random.Generator) -> None:
    """Change an action (k,) in place: its steer or its speed, occasionally the whole action."""
    kind = rng.random()
    if n_actions:
        steer, speed = (action[0] - 1) // 3, (action[0] - 1) % 3
        if action[0] == 0 or kind < 0.15:
            action[0] = rng.integers(0, n_actions)
        elif kind < 0.2:
            action[0] = 0
        elif kind < 0.6:
            action[0] = 1 + 3 * rng.integers(0, n_actions // 3) + speed
        else:
            action[0] = 1 + 3 * steer + rng.integers(0, 3)
        return
    axis = 0 if kind < 0.5 else 1 if kind < 0.95 else 2
    if rng.random() < 0.1:
        action[axis] = -FULL_SCALE if axis == 2 else 0
    else:
        change = rng.normal(0.0, math.exp(rng.uniform(0.0, math.log(0.3 * FULL_SCALE))))
        action[axis] = min(max(round(action[axis] + change), -FULL_SCALE), FULL_SCALE)


@numba.njit(cache=True)
def shift_end(plan: NDArray[Any], length: int, first: int, last: int, by: int, rng: np.random.Generator) -> int:
    """End the segment [first, last) ``by`` decisions later or earlier; the plan's new length."""
    later = rng.random() < 0.5
    ripple = rng.random() < RIPPLE_RATE
    if later:
        length = resize_segment(plan, length, last, last if ripple else min(last + by, length), by)
        for t in range(last, min(last + by, length)):
            plan[t] = plan[first]
    elif ripple or last == length:
        length = resize_segment(plan, length, max(last - by, first), last, 0)
    else:
        for t in range(max(last - by, first), last):
            plan[t] = plan[last]
    return length


@numba.njit(cache=True)
def replace_segment(plan: NDArray[Any], first: int, last: int, n_actions: int, rng: np.random.Generator) -> None:
    """Give the decisions [first, last) one mutated action."""
    mutate_action(plan[first], n_actions, rng)
    for t in range(first + 1, last):
        plan[t] = plan[first]


@numba.njit(cache=True)
def remove_segment(plan: NDArray[Any], length: int, first: int, last: int, rng: np.random.Generator) -> int:
    """Remove the segment [first, last): what follows moves up, or fills the gap; the plan's new length."""
    if last == length or rng.random() < RIPPLE_RATE:
        return resize_segment(plan, length, first, last, 0)
    for t in range(first, last):
        plan[t] = plan[last]
    return length


@numba.njit(cache=True)
def rescale_segment(
    plan: NDArray[Any], length: int, first: int, last: int, n_actions: int, rng: np.random.Generator
) -> int:
    """Play the decisions [first, last) slower or faster, or scale a continuous axis; the plan's new length."""
    factor = math.exp(rng.normal(0.0, 0.15))
    if n_actions or rng.random() < 0.5:
        old = plan[first:last].copy()
        room = max(round(factor * (last - first)), 1)
        length = resize_segment(plan, length, first, last, room)
        for t in range(first, min(first + room, length)):
            plan[t] = old[min(int((t - first) / factor), len(old) - 1)]
    else:
        axis = int(rng.integers(0, 2))
        for t in range(first, last):
            plan[t, axis] = min(max(round(plan[t, axis] * factor), -FULL_SCALE), FULL_SCALE)
    return length


@numba.njit(cache=True)
def mutate(plan: NDArray[Any], length: int, n_actions: int, idle: NDArray[Any], rng: np.random.Generator) -> int:
    """Mutate one segment of a plan in place, or a stretch that begins in it; the plan's new length."""
    if length == 0:
        plan[0] = idle
        length = 1
    first = int(rng.integers(0, length))
    last = first + 1
    while first > 0 and (plan[first - 1] == plan[first]).all():
        first -= 1
    while last < length and (plan[last] == plan[first]).all():
        last += 1
    kind = rng.random()
    by = random_duration(rng)
    if kind < 0.3:
        length = shift_end(plan, length, first, last, by, rng)
    elif kind < 0.55:
        replace_segment(plan, first, last, n_actions, rng)
    elif kind < 0.7:  # a part of the segment
        first = int(rng.integers(first, last))
        replace_segment(plan, first, min(first + by, last), n_actions, rng)
    elif kind < 0.8:  # insert a new segment before it
        length = resize_segment(plan, length, first, first, by)
        replace_segment(plan, first, min(first + by, length), n_actions, rng)
    elif kind < 0.9:
        length = remove_segment(plan, length, first, last, rng)
    elif kind < 0.95:  # wait at the start of the episode
        length = resize_segment(plan, length, 0, 0, by)
        for t in range(min(by, length)):
            plan[t] = idle
    else:
        last = int(rng.integers(first, length)) + 1
        length = rescale_segment(plan, length, first, last, n_actions, rng)
    return length


@numba.njit(cache=True)
def make_offspring(
    parents: NDArray[Any],
    lengths: NDArray[Any],
    mates: NDArray[Any],
    mate_lengths: NDArray[Any],
    offspring: NDArray[Any],
    n_actions: int,
    idle: NDArray[Any],
    rng: np.random.Generator,
) -> None:
    """Write one offspring of each parent: a copy, sometimes crossed with a mate, and mutated.

    A crossover joins the first part of the parent and the last part of the mate, cut within five decisions of the same
    one; it is followed by a mutation half of the time. Without a crossover there is at least one mutation.

    Args:
        parents: (n, decisions, k) plans.
        lengths: (n,) of the parents.
        mates: (n, decisions, k) plans.
        mate_lengths: (n,).
        offspring: (n, decisions, k) idle plans, written.
        n_actions: size of a discrete action set; 0 for a continuous one.
        idle: (k,) the action that does nothing.
        rng: draws everything.
    """
    for i in range(len(offspring)):
        plan = offspring[i]
        length = lengths[i]
        plan[:length] = parents[i, :length]
        crossover = rng.random() < CROSSOVER_RATE
        if crossover:
            cut = rng.integers(0, length + 1)
            mate_cut = min(max(cut + rng.integers(-5, 6), 0), mate_lengths[i])
            rest = min(mate_lengths[i] - mate_cut, len(plan) - cut)
            plan[cut : cut + rest] = mates[i, mate_cut : mate_cut + rest]
            length = cut + rest
        again = not crossover or rng.random() < CONTINUE_RATE
        while again:
            length = mutate(plan, length, n_actions, idle, rng)
            again = rng.random() < CONTINUE_RATE
        for t in range(length, len(plan)):
            plan[t] = idle
