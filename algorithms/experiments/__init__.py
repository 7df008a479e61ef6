"""What is run: configs, run directories, loggers, training, jobs and worker processes."""
