"""The commands of the legs, as entry points declare them."""

from msk_ray.cli import Command

GAIT = Command("msk_ray.legs.gait.__main__", "measure how a leg policy walks, compared with people")
