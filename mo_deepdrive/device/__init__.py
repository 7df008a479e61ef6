"""Worlds whose arrays are torch tensors: on a GPU, or by the same functions on the CPU."""
