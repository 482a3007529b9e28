"""Sweeps on Ray Tune: the one room that imports Ray.

What a sweep tries and when it stops a trial is decided in `sweep`, and what it leaves on disk is kept by `experiment`;
neither knows of this room.
"""
