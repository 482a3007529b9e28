"""Gait analysis of legs: series from states, gait cycles, measures, and the same of healthy people."""
