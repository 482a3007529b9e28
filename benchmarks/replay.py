"""How long a recorded graph takes."""

import time

import warp as wp

from msk_ray.step.forward import Graph


def milliseconds(graph: Graph, device: wp.Device, repeats: int) -> float:
    """Median of five timings of `repeats` replays, per replay."""
    timings = []
    for _ in range(6):
        wp.synchronize_device(device)
        begin = time.perf_counter()
        for _ in range(repeats):
            graph.replay()
        wp.synchronize_device(device)
        timings.append((time.perf_counter() - begin) * 1e3 / repeats)
    return sorted(timings[1:])[2]
