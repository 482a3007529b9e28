"""Model builders: settings in, a compiled MjModel out."""
