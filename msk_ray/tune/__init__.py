"""Experiments: many trials resolved from a search space and run side by side by Ray Tune.

The only layer that imports Ray, and it does so in three rooms alone: `runner`, `adapters` and `progress`. Everything
that decides something (which trials, when to stop one, how to name its end) is plain Python beside them.
"""
