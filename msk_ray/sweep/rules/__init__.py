"""When a trial ends before its last epoch: rules by its own history, and rules that compare trials.

Each is a class with its settings, in a separate file. Pure: no Ray, no files, no clock.
"""
