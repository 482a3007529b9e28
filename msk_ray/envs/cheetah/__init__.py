"""A planar body on two legs with six motors, in two named physics."""
