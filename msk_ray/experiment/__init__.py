"""The files of experiments and trials: names, writing, and reading them back, damaged or not. No Ray, no torch."""
