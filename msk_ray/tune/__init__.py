"""Sweeps on Ray Tune: the only package that imports Ray.

`sweep` decides what a sweep tries and when it stops a trial, and `experiment` reads and writes its files; neither
depends on this package.
"""
