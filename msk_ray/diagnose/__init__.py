"""Gradient quality along real trajectories of a policy."""

from msk_ray.diagnose.probe import STATE_KINDS, Quality, Subject, probe, read_subject

__all__ = ["STATE_KINDS", "Quality", "Subject", "probe", "read_subject"]
