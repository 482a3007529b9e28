"""The usual case: a model from an MJCF file, with an observation and a reward of one's own."""
