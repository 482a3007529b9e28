"""The commands of motion tracking, as entry points declare them."""

from msk_ray.cli import Command

MOTIONS = Command("msk_ray.robots.tracking.list_motions", "list motions to follow, check them and draw them")
TRACK = Command("msk_ray.robots.tracking.track", "score a policy on each clip, followed once from its first frame")
