"""Rules that end trials before their last epoch: by a trial's own history, or by comparing trials.

Each is a class with its settings, in a separate file. Pure: no Ray, no files, no clock.
"""
