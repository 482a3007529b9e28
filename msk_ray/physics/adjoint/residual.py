"""The force balance a solver left open."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def residual_share(
    # Model:
    nv: int,
    inertia_rownnz: wp.array[int],
    inertia_rowadr: wp.array[int],
    inertia_colind: wp.array[int],
    # In:
    inertia_in: wp.array2d[float],
    qacc_in: wp.array2d[float],
    smooth_in: wp.array2d[float],
    constraint_in: wp.array2d[float],
    # Out:
    product_out: wp.array2d[float],
    worst_out: wp.array[float],
):
    """Keeps the largest |Ma - τ - Jᵀf| / (|Ma| + |τ| + |Jᵀf|) of each world; NaN stays NaN."""
    worldid = wp.tid()
    for i in range(nv):
        product_out[worldid, i] = 0.0
    for i in range(nv):
        start = inertia_rowadr[i]
        for k in range(start, start + inertia_rownnz[i]):
            j = inertia_colind[k]
            entry = inertia_in[worldid, k]
            product_out[worldid, i] += entry * qacc_in[worldid, j]
            if j != i:
                product_out[worldid, j] += entry * qacc_in[worldid, i]
    gap = float(0.0)
    size = float(1.0e-12)
    for i in range(nv):
        ma = product_out[worldid, i]
        tau = smooth_in[worldid, i]
        push = constraint_in[worldid, i]
        r = ma - tau - push
        gap += r * r
        size += ma * ma + tau * tau + push * push
    share = wp.sqrt(gap / size)
    if not (share <= worst_out[worldid]):
        worst_out[worldid] = share
