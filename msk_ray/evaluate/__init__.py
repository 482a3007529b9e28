"""What is a policy worth? Deterministic evaluation of checkpoints, trials and whole experiments."""
