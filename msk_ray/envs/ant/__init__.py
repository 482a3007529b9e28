"""A four-legged walker with motors, in four named physics."""
