"""Deterministic evaluation of checkpoints, trials, whole experiments and zoos."""
