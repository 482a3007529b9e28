"""A walker on two legs with 21 motors, in two named physics."""
