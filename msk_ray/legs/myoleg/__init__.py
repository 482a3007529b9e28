"""Muscle-driven legs of an installed package or of a model file."""
