"""What the algorithms share: environment adapter, rollouts, networks, advantages, checkpoints, Pareto indicators."""
