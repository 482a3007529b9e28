"""Watch a task in a viewer: a policy, or actions that are none."""

NO_DISPLAY = (
    "there is no display: add --browser (pip install 'msk-ray[browser]'), or make a film with msk-ray visualize --video"
)
"""What to do where no window can be opened."""
