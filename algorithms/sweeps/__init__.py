"""Many runs from one YAML file.

A *sweep* is a base experiment and what varies. A *cell* is one combination of the varied values; the runs of a cell
differ in their seed alone. The *manifest* lists all runs. A *backend* trains them: worker processes on this machine,
Ray Tune, or Slurm (the batch script is in :mod:`algorithms.sweeps.slurm_script`).
"""

BACKENDS = ("local", "ray", "slurm", "manifest")  # the last one only writes the manifest
