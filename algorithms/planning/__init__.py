"""Search over action sequences: best-known fronts of a scenario, and the best drives of the suite's tasks."""
