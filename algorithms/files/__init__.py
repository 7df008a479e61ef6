"""Files of runs: YAML, metrics, fronts, checkpoints."""
