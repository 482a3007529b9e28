"""Unitree's G1 follows motions of people: mjlab's task, libraries of motions, and scores for each clip."""
