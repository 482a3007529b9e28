"""What environments of muscle-driven legs share."""
