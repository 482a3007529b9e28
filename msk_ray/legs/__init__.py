"""Muscle-driven legs: environments, gait analysis, and scoring in MyoSuite.

A plug-in: the runner finds everything here by the entry points of this distribution, as it finds another package's, and
imports nothing of it.
"""
