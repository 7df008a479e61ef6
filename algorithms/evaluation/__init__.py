"""What is measured: metrics, evaluation, statistics, fronts."""
