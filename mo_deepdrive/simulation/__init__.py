"""The driving simulator: pure compiled functions over caller-owned record arrays."""
