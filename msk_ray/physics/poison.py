"""The kernel that ends an env step: results of a world that lost contacts or rows become NaN."""

import math

import warp as wp

_NAN = wp.constant(math.nan)


@wp.kernel
def note_losses(
    # In:
    overflow_in: wp.array[int],
    nefc_in: wp.array[int],
    nacon_in: wp.array[int],
    ncollision_in: wp.array[int],
    lost_bits: int,
    # Out:
    qpos_out: wp.array2d[float],
    qvel_out: wp.array2d[float],
    act_out: wp.array2d[float],
    peaks_out: wp.array[int],
    heard_out: wp.array[int],
) -> None:
    """Per world: raise the peaks; where the step lost something, make its results NaN and tell the host."""
    world = wp.tid()
    if nefc_in[world] > peaks_out[1]:
        wp.atomic_max(peaks_out, 1, nefc_in[world])
    if world == 0:
        peaks_out[0] = wp.max(peaks_out[0], wp.max(nacon_in[0], ncollision_in[0]))
    if (overflow_in[world] & lost_bits) != 0:
        for i in range(qpos_out.shape[1]):
            qpos_out[world, i] = _NAN
        for i in range(qvel_out.shape[1]):
            qvel_out[world, i] = _NAN
        for i in range(act_out.shape[1]):
            act_out[world, i] = _NAN
        heard_out[0] = 1
