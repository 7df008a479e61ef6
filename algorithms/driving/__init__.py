"""Scripted drivers: fixed rules that see what an agent observes."""
