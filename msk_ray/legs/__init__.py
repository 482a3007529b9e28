"""The shared part of the environments of muscle-driven legs."""
