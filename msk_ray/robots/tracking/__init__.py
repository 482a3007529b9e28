"""Unitree's G1 follows motions of people: mjlab's task, a library of motions, and scores over all of its clips."""
