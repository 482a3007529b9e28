"""Legged robots that follow velocity commands: Unitree's Go1 and G1 in the tasks of mjlab, and scoring in mjlab.

A plug-in: the runner finds everything here by the entry points of this distribution, as it finds another package's, and
imports nothing of it.
"""
