"""Legged robots that follow velocity commands: Unitree's Go1 and G1 in the tasks of mjlab, and scoring in mjlab.

A plug-in: the runner imports nothing from here. It finds everything through the entry points of this distribution, just
as it finds the plug-ins of other packages.
"""
