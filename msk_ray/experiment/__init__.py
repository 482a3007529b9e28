"""The files of experiments and trials: their names, how they are written, and how they are read back in any condition.
No Ray, no torch."""
