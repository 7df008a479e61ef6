"""Networks and how they learn: modules, actors, losses, optimisers, return distributions, threads."""
