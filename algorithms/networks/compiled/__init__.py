"""Fast gradients on the CPU, compiled: perceptrons, distributions of actions, matrix products, the tape."""
