"""Numbers of a world, one, or four side by side at a time.

Warp computes an address from 64-bit products of every index and its stride. In loops of a few operations for each
number that is most of the work. So places are counted here in 32 bits, and four numbers are one access on a GPU. Arrays
of vec4 begin at multiples of 16 bytes, as Warp allocates them.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

MOST_ELEMENTS = 2**29
"""Of an array, so that the places of its single numbers fit into 32 bits."""

_NUMBER = "[world * (a.strides[0] >> 2) + k * (a.strides[1] >> 2)]"
_FOUR = "[world * (a.strides[0] >> 4) + k * (a.strides[1] >> 4)]"
_ENTRY = "[4 * (world * (a.strides[0] >> 4) + (k >> 2) * (a.strides[1] >> 4)) + (k & 3)]"


@wp.func_native(f"return a.data{_NUMBER};")
def number(a: wp.array2d[float], world: int, k: int) -> float: ...


@wp.func_native(f"a.data{_NUMBER} = value;")
def put_number(a: wp.array2d[float], world: int, k: int, value: float) -> None: ...


@wp.func_native(f"return a.data{_NUMBER};")
def whole(a: wp.array2d[int], world: int, k: int) -> int: ...


@wp.func_native(f"a.data{_NUMBER} = value;")
def put_whole(a: wp.array2d[int], world: int, k: int, value: int) -> None: ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const float4 v = reinterpret_cast<const float4*>(a.data){_FOUR};
    return wp::vec_t<4, wp::float32>(v.x, v.y, v.z, v.w);
#else
    return a.data{_FOUR};
#endif
""")
def four(a: wp.array2d[wp.vec4], world: int, k: int) -> wp.vec4: ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    reinterpret_cast<float4*>(a.data){_FOUR} = make_float4(value[0], value[1], value[2], value[3]);
#else
    a.data{_FOUR} = value;
#endif
""")
def put_four(a: wp.array2d[wp.vec4], world: int, k: int, value: wp.vec4) -> None: ...


# Single numbers of arrays of vec4.


@wp.func_native(f"return reinterpret_cast<const float*>(a.data){_ENTRY};")
def entry(a: wp.array2d[wp.vec4], world: int, k: int) -> float: ...


@wp.func_native(f"reinterpret_cast<float*>(a.data){_ENTRY} = value;")
def put_entry(a: wp.array2d[wp.vec4], world: int, k: int, value: float) -> None: ...
