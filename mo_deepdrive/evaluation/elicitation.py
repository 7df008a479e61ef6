"""Weights of objectives from answers to "which of these two drives do you prefer?".

Returns are divided by the objectives' scales, R in R^d. A person with weights w of the simplex prefers the drive a to b
with the probability 1 / (1 + exp(-w . (R_a - R_b) / T)) (R. A. Bradley, M. E. Terry, "Rank analysis of incomplete block
designs", Biometrika 39, 1952), T the temperature. The posterior over weights is that of samples, uniform on the simplex
at first: each has the product of the probabilities of the answers. The next question is the pair of drives of which the
answer tells most about w, that is with the greatest H(E p) - E H(p), H the entropy of an answer, E over the posterior
(N. Houlsby et al., "Bayesian active learning for classification and preference learning", arXiv:1112.5745, 2011); of
equals the first, in the order (0, 1), (0, 2), ..., (1, 2), ...; a pair is asked once.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

QUESTIONS = 7
SAMPLES = 400
INTERVAL = (0.05, 0.95)  # of weights, in quantiles
HARDNESS = 0.25  # the temperature, in standard deviations of how much better a drive is than another
NEVER = 1e-12  # the least probability of an answer


def simplex_samples(objectives: int, count: int = SAMPLES) -> Floats:
    """Weights (count, d) that are uniform on the simplex, always the same ones."""
    return np.random.default_rng(0).dirichlet(np.ones(objectives), count)


def temperature(utilities: Floats) -> float:
    """T for the utilities (S, K) of K drives under S weights: HARDNESS; 1 if all drives are equal."""
    spread = float(np.std(utilities[:, :, None] - utilities[:, None, :]))
    return HARDNESS * spread if spread > 0.0 else 1.0


def answer_probabilities(utilities: Floats, pair: tuple[int, int], temperature: float) -> Floats:
    """The probabilities (S,) that the first drive of a pair is preferred, for utilities (S, K)."""
    difference = (utilities[:, pair[0]] - utilities[:, pair[1]]) / temperature
    return np.asarray(np.clip(1.0 / (1.0 + np.exp(-np.clip(difference, -500.0, 500.0))), NEVER, 1.0 - NEVER))


def posterior(utilities: Floats, answers: Sequence[tuple[int, int]], temperature: float) -> Floats:
    """Shares (S,) of the samples after answers (preferred, other)."""
    shares = np.full(len(utilities), 1.0 / len(utilities))
    for answer in answers:
        shares = shares * answer_probabilities(utilities, answer, temperature)
        shares /= shares.sum()
    return shares


def _entropy(p: Floats) -> Floats:
    return np.asarray(-(p * np.log(p) + (1.0 - p) * np.log(1.0 - p)))


def next_pair(utilities: Floats, answers: Sequence[tuple[int, int]], temperature: float) -> tuple[int, int] | None:
    """The pair of which the answer tells most; None if all have been asked."""
    shares, asked = posterior(utilities, answers, temperature), {tuple(sorted(answer)) for answer in answers}
    best, most = None, -1.0
    for pair in combinations(range(utilities.shape[1]), 2):
        if pair not in asked:
            p = answer_probabilities(utilities, pair, temperature)
            told = float(_entropy(np.array(shares @ p)) - shares @ _entropy(p))
            if told > most + 1e-12:
                best, most = pair, told
    return best


def weight_interval(samples: Floats, shares: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean (d,) of the weights, and the ends (d,) of their INTERVAL: the first sample at which the shares reach it."""
    order = np.argsort(samples, axis=0, kind="stable")
    reached = np.cumsum(shares[order], axis=0)
    ends = [
        np.take_along_axis(samples, order, 0)[(reached >= share - 1e-12).argmax(axis=0), np.arange(samples.shape[1])]
        for share in INTERVAL
    ]
    return shares @ samples, ends[0], ends[1]


def question_tree(returns: Floats, questions: int = QUESTIONS) -> dict[str, list[Any]]:
    """All that can be asked about K drives with scaled returns (K, d), and what each list of answers says.

    Returns:
        ``ask``, pairs of drives by node, and ``found``, {weights, low, high, best} by leaf: their means, the ends of
        their INTERVAL, and the drive that is worth most. The first node is 1; if the first of the pair is preferred, n
        becomes 2 n, else 2 n + 1: ``ask[n - 1]``, and ``found[n - 2 ** questions]`` in the end.
    """
    samples = simplex_samples(returns.shape[1])
    utilities = samples @ returns.T
    hardness = temperature(utilities)
    answers: list[list[tuple[int, int]]] = [[], []]  # by node; no node is 0
    ask = []
    for node in range(1, 2**questions):
        pair = next_pair(utilities, answers[node], hardness)
        if pair is None:
            raise ValueError(f"{len(returns)} drives are too few for {questions} questions")
        ask.append(list(pair))
        answers += [[*answers[node], pair], [*answers[node], pair[::-1]]]
    found = []
    for given in answers[2**questions :]:
        mean, low, high = weight_interval(samples, posterior(utilities, given, hardness))
        weights = {"weights": mean, "low": low, "high": high}
        found.append({name: values.round(3).tolist() for name, values in weights.items()})
        found[-1]["best"] = int((returns @ mean).argmax())
    return {"ask": ask, "found": found}
