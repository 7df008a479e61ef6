"""Running experiments: configurations, run directories, logging, training, jobs and worker processes."""
