"""Reproduction of the paper's figures and claims.

The study configs/studies/paper.yaml lists what is trained. A *task* is a scenario under a utility. A *protocol* is how
a task is trained and evaluated: with the hyperparameters as printed in the paper, with tuned ones (best effort), or an
ablation. The *variants* of a protocol, such as A2C and MO-A2C, are compared with each other over several seeds.
"""

# The paper's figures and claims that are reproduced, by their numbers.
FIGURES = range(4, 11)
CLAIM_NUMBERS = range(1, 7)
