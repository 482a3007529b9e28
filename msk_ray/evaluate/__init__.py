"""How good is a policy? Deterministic evaluation of checkpoints, trials and whole experiments."""
