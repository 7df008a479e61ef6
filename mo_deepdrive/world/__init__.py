"""Worlds and what describes them: scenarios, objectives, routes, settings, and batches of worlds."""
