"""A contact of two geoms, and what its cotangents give them."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Geom:
    """One geom of a contact, in the world."""

    type: wp.int32
    pos: wp.vec3
    mat: wp.mat33
    size: wp.vec3


@wp.struct
class ContactPoint:
    """A contact as mujoco_warp returned it."""

    dist: wp.float32
    point: wp.vec3
    normal: wp.vec3


@wp.struct
class Bars:
    """Cotangents of a contact's distance, point and normal."""

    dist: wp.float32
    point: wp.vec3
    normal: wp.vec3


@wp.struct
class PairPush:
    """Forces on two geoms and the places at which they act, and torques."""

    force1: wp.vec3
    torque1: wp.vec3
    place1: wp.vec3
    force2: wp.vec3
    torque2: wp.vec3
    place2: wp.vec3
