"""How does a policy walk? Outcome measures of gait analysis, beside those of people."""
