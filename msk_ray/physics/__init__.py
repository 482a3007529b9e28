"""Batched MuJoCo Warp physics. Warp only: nothing here imports torch."""

from msk_ray.physics.batch import WorldBatch
from msk_ray.physics.graph import Graph
from msk_ray.physics.taped import TapedStep, WarpState

__all__ = ["Graph", "TapedStep", "WarpState", "WorldBatch"]
