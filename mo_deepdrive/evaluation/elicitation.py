"""Weights of objectives from answers to "which of these two drives do you prefer?".

Returns are divided by the objectives' scales, R in R^d. A person with weights w of the simplex prefers the drive a to b
with the probability 1 / (1 + exp(-w . (R_a - R_b) / T)) (R. A. Bradley, M. E. Terry, "Rank analysis of incomplete block
designs", Biometrika 39, 1952), T the temperature. The posterior over weights is that of samples, uniform on the simplex
at first: each has the product of the probabilities of the answers. The next question is the pair of drives of which the
answer tells most about w, that is with the greatest H(E p) - E H(p), H the entropy of an answer, E over the posterior
(N. Houlsby et al., "Bayesian active learning for classification and preference learning", arXiv:1112.5745, 2011); of
equals the first, in the order (0, 1), (0, 2), ..., (1, 2), ...; a pair is asked once.
"""
