"""Evaluation of policies in mjlab's own environments."""
