"""The usual case: a model from an MJCF file, with your own observation and reward."""
