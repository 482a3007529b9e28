"""Scoring in mjlab's own environments."""
