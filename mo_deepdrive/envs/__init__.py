"""The environments: single, turn-based, vector, PettingZoo and RLlib."""
