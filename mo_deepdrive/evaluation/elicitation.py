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


class Elicitation:
    """What can be asked about K drives with scaled returns (K, d), and what answers say, pairs (preferred, other)."""

    def __init__(self, returns: Floats):
        self.weights = np.random.default_rng(0).dirichlet(np.ones(returns.shape[1]), SAMPLES)  # the same for all
        utilities = self.weights @ returns.T
        better = utilities[:, :, None] - utilities[:, None, :]
        temperature = HARDNESS * float(np.std(better)) or 1.0
        logits = np.clip(better / temperature, -500.0, 500.0)
        #: (SAMPLES, K, K) probabilities that the first drive is preferred to the second
        self.preferred = np.clip(1.0 / (1.0 + np.exp(-logits)), NEVER, 1.0 - NEVER)

    def posterior(self, answers: Sequence[tuple[int, int]]) -> Floats:
        """Shares (SAMPLES,) of the weights after some answers."""
        shares = np.full(SAMPLES, 1.0 / SAMPLES)
        for preferred, other in answers:
            shares = shares * self.preferred[:, preferred, other]
            shares /= shares.sum()
        return shares

    def next_pair(self, answers: Sequence[tuple[int, int]]) -> tuple[int, int] | None:
        """The pair of which the answer tells most; None if all have been asked."""
        asked = {tuple(sorted(answer)) for answer in answers}
        pairs = [pair for pair in combinations(range(self.preferred.shape[1]), 2) if pair not in asked]
        if not pairs:
            return None
        first, second = np.array(pairs).T
        shares, p = self.posterior(answers), self.preferred[:, first, second]
        told = _entropy(shares @ p) - shares @ _entropy(p)
        return pairs[int(told.round(12).argmax())]

    def estimate(self, answers: Sequence[tuple[int, int]]) -> tuple[Floats, Floats, Floats]:
        """Means (d,) of the weights after some answers, and the ends (d,) of their INTERVAL."""
        shares = self.posterior(answers)
        low, high = np.quantile(self.weights, INTERVAL, axis=0, weights=shares, method="inverted_cdf")
        return shares @ self.weights, low, high


def _entropy(p: Floats) -> Floats:
    return np.asarray(-(p * np.log(p) + (1.0 - p) * np.log(1.0 - p)))


def question_tree(returns: Floats, questions: int = QUESTIONS) -> dict[str, list[Any]]:
    """All that can be asked about K drives with scaled returns (K, d), and what each list of answers says.

    Returns:
        ``ask``, pairs of drives by node, and ``found``, {weights, low, high, best} by leaf: their means, the ends of
        their INTERVAL, and the drive that is worth most. The first node is 1; if the first of the pair is preferred, n
        becomes 2 n, else 2 n + 1: ``ask[n - 1]``, and ``found[n - 2 ** questions]`` in the end.
    """
    elicitation, ask, found = Elicitation(returns), [], []
    answers: list[list[tuple[int, int]]] = [[], []]  # by node; no node is 0
    for node in range(1, 2**questions):
        pair = elicitation.next_pair(answers[node])
        if pair is None:
            raise ValueError(f"{len(returns)} drives are too few for {questions} questions")
        ask.append(list(pair))
        answers += [[*answers[node], pair], [*answers[node], pair[::-1]]]
    for given in answers[2**questions :]:
        estimate = elicitation.estimate(given)
        named = zip(("weights", "low", "high"), estimate, strict=True)
        best = int((returns @ estimate[0]).argmax())
        found.append({**{name: values.round(3).tolist() for name, values in named}, "best": best})
    return {"ask": ask, "found": found}
