"""Watch a task in a viewer: a policy, or actions that are none."""
