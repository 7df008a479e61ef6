"""Experiments as data: studies, sweeps, and the reproduction of the paper.

A *study* trains some *learners* on some *tasks*. An *arm* is a learner on a task. Where a study tunes, every arm first
tries settings on the validation split, the same number for every arm; the best of them is then trained with the seeds
that count, which are scored on the test split. A *sweep* is a base experiment and what varies. A *cell* is one
combination of the varied values; the runs of a cell differ in their seed alone. The *manifest* lists all runs. A
*backend* trains them: worker processes on this machine, Ray Tune, or Slurm (the batch script is in
:mod:`algorithms.studies.slurm`). The study configs/studies/paper.yaml lists what the reproduction trains: a *protocol*
is how a scenario under a utility is trained and evaluated, its learners are compared with each other.
"""

BACKENDS = ("local", "ray", "slurm", "manifest")  # the last one only writes the manifest

# The paper's figures and claims that are reproduced, by their numbers.
FIGURES = range(4, 11)
CLAIM_NUMBERS = range(1, 7)

REFERENCE = "studies/suite"  # the study of the suite's reference results
CORE, ALL = "core", "all"  # instead of the suite's tasks
