"""A planar body on one leg with three motors, in two named physics."""
