"""Copies of whole contacts, as mujoco_warp stores them after collision detection."""

import warp as wp

from msk_ray.step.forward.mjw_private import vec5

wp.set_module_options({"enable_backward": False})


@wp.struct
class ContactRecords:
    """All arrays that mujoco_warp has of contacts after collision detection, (C,), for moving contacts.

    Without the addresses of constraint rows, which do not exist yet.
    """

    dist: wp.array[float]
    pos: wp.array[wp.vec3]
    frame: wp.array[wp.mat33]
    includemargin: wp.array[float]
    friction: wp.array[vec5]
    solref: wp.array[wp.vec2]
    solreffriction: wp.array[wp.vec2]
    solimp: wp.array[vec5]
    dim: wp.array[int]
    geom: wp.array[wp.vec2i]
    worldid: wp.array[int]
    type: wp.array[int]
    geomcollisionid: wp.array[int]
    adhesion: wp.array[float]


@wp.func
def copy_contact(source: ContactRecords, i: int, target: ContactRecords, j: int) -> None:
    """Copy a contact to another place."""
    target.dist[j] = source.dist[i]
    target.pos[j] = source.pos[i]
    target.frame[j] = source.frame[i]
    target.includemargin[j] = source.includemargin[i]
    target.friction[j] = source.friction[i]
    target.solref[j] = source.solref[i]
    target.solreffriction[j] = source.solreffriction[i]
    target.solimp[j] = source.solimp[i]
    target.dim[j] = source.dim[i]
    target.geom[j] = source.geom[i]
    target.worldid[j] = source.worldid[i]
    target.type[j] = source.type[i]
    target.geomcollisionid[j] = source.geomcollisionid[i]
    target.adhesion[j] = source.adhesion[i]
