"""Gradient quality along real trajectories of a policy."""
