"""How does a policy walk? Measures of gait analysis, compared with those of people."""
