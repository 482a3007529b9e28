"""The force balance a solver left open."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def residual_squares(
    # Model:
    inertia_address: wp.array2d[int],
    # In:
    inertia_in: wp.array2d[float],
    qacc_in: wp.array2d[float],
    smooth_in: wp.array2d[float],
    constraint_in: wp.array2d[float],
    # Out:
    gap_out: wp.array[float],
    size_out: wp.array[float],
) -> None:
    """Adds one dof's (Ma - τ - Jᵀf)² to its world's gap, and (Ma)² + τ² + (Jᵀf)² to its size."""
    worldid, i = wp.tid()
    product = float(0.0)
    for j in range(inertia_address.shape[0]):
        address = inertia_address[wp.max(i, j), wp.min(i, j)]
        if address >= 0:
            product += inertia_in[worldid, address] * qacc_in[worldid, j]
    tau = smooth_in[worldid, i]
    push = constraint_in[worldid, i]
    r = product - tau - push
    wp.atomic_add(gap_out, worldid, r * r)
    wp.atomic_add(size_out, worldid, product * product + tau * tau + push * push)


@wp.kernel
def residual_share(
    # Out:
    gap_out: wp.array[float],
    size_out: wp.array[float],
    worst_out: wp.array[float],
) -> None:
    """Keeps the largest √(gap/size) of each world and clears both for the next step; NaN stays NaN."""
    worldid = wp.tid()
    share = wp.sqrt(gap_out[worldid] / (size_out[worldid] + 1.0e-12))
    if not (share <= worst_out[worldid]):
        worst_out[worldid] = share
    gap_out[worldid] = 0.0
    size_out[worldid] = 0.0
