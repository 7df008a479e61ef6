"""Learners that stay on one device, with the seeds of a run as the first axis of every tensor."""
