"""Policy learning through differentiable MuJoCo Warp, swept with Ray Tune."""

__version__ = "0.1.0"
