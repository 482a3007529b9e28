"""A four-legged walker with motors, in three named physics."""
