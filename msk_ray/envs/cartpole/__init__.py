"""A pole on a cart: swing it up and keep it there."""
