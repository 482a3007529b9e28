"""Batched MuJoCo Warp physics. Warp only: nothing here imports torch."""

import os

import warp as wp

# Set before anything initialises Warp, which would otherwise print a line for each of thirty modules.
wp.config.log_level = wp.LOG_WARNING
# For tests and the programs that they start: compiled in half the time, for steps that are few.
if "MSK_RAY_UNOPTIMIZED_KERNELS" in os.environ:
    wp.config.optimization_level = 0

from msk_ray.step.forward.no_gpu import start_quietly  # noqa: E402

start_quietly()

from msk_ray.step.forward.batch import WorldBatch  # noqa: E402
from msk_ray.step.forward.compilation import compile_kernels, on_compiling  # noqa: E402
from msk_ray.step.forward.graph import Graph, joined_stream, joining_capture  # noqa: E402
from msk_ray.step.forward.stages import Kernels  # noqa: E402

__all__ = [
    "Graph",
    "Kernels",
    "WorldBatch",
    "compile_kernels",
    "joined_stream",
    "joining_capture",
    "on_compiling",
]
