"""The threads that work on one world: the lanes of a warp on a GPU, one on a CPU.

All lanes of a world take the same branches where they synchronise: decisions depend on a `lane_sum`, which has the same
bits in all lanes. A world's numbers are contiguous in memory and indexed with 32 bits, because computing Warp's 64-bit
addresses would be most of the work.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

WARP = 32


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
""")
def lane_count() -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def lane_sync() -> None: ...


# Lanes i and i ^ offset add the same two numbers, so that all lanes end with the same bits.
@wp.func_native("""
    float total = x;
#if defined(__CUDA_ARCH__)
    for (int offset = 16; offset > 0; offset >>= 1)
        total += __shfl_xor_sync(0xffffffffu, total, offset);
#endif
    return total;
""")
def lane_sum(x: float) -> float: ...


@wp.func
def lane_sums(v: wp.vec3) -> wp.vec3:
    return wp.vec3(lane_sum(v[0]), lane_sum(v[1]), lane_sum(v[2]))


@wp.func_native("return a.data[k];")
def at(a: wp.array[float], k: int) -> float: ...


@wp.func_native("a.data[k] = value;")
def put(a: wp.array[float], k: int, value: float) -> None: ...


@wp.func_native("return a.data[k];")
def whole(a: wp.array[int], k: int) -> int: ...


@wp.func_native("a.data[k] = value;")
def put_whole(a: wp.array[int], k: int, value: int) -> None: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 v = *reinterpret_cast<const float4*>(a.data + k);
    return wp::vec_t<4, wp::float32>(v.x, v.y, v.z, v.w);
#else
    return wp::vec_t<4, wp::float32>(a.data[k], a.data[k + 1], a.data[k + 2], a.data[k + 3]);
#endif
""")
def four(a: wp.array[float], k: int) -> wp.vec4: ...
