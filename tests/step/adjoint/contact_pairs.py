"""Two free bodies that touch: their poses, moved and turned, and what the adjoint pulls their contacts back to."""

from typing import NamedTuple

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp import GeomType

from msk_ray.step.adjoint.groups import Meshes, Shapes, gather
from msk_ray.step.adjoint.laws.contact_geometry.capsule_box import capsule_box_push
from msk_ray.step.adjoint.laws.contact_geometry.contact_point import Bars, ContactPoint, Geom
from msk_ray.step.adjoint.laws.contact_geometry.convex import convex_wrenches, solid_of
from msk_ray.step.adjoint.laws.contact_geometry.solids import Solid


class PlacedContact(NamedTuple):
    """A contact with the poses of both geoms, and weights of its distance, point and normal."""

    geom_pos: np.ndarray
    geom_mat: np.ndarray
    body_pos: np.ndarray
    index: int
    """Among the contacts of the pair."""
    values: np.ndarray
    """Distance, point and normal, 7 numbers."""
    weight: np.ndarray


@wp.func
def geom_of(solid: Solid) -> Geom:
    geom = Geom()
    geom.type = solid.type
    geom.pos = solid.pos
    geom.mat = solid.mat
    geom.size = solid.size
    return geom


@wp.kernel(enable_backward=False)
def pull_pairs(
    shapes: Shapes,
    meshes: Meshes,
    native_ccd: int,
    multi_ccd: int,
    index: wp.array[int],
    xpos: wp.array2d[wp.vec3],
    xmat: wp.array2d[wp.mat33],
    values: wp.array2d[float],
    weight: wp.array2d[float],
    out: wp.array2d[wp.vec3],
    exact_out: wp.array[wp.bool],
):
    """Forces on both geoms and torques about the contact's point."""
    i = wp.tid()
    solid1 = solid_of(0, i, shapes, meshes, xpos, xmat)
    solid2 = solid_of(1, i, shapes, meshes, xpos, xmat)
    contact = ContactPoint()
    contact.dist = values[i, 0]
    contact.point = wp.vec3(values[i, 1], values[i, 2], values[i, 3])
    contact.normal = wp.vec3(values[i, 4], values[i, 5], values[i, 6])
    bars = Bars()
    bars.dist = weight[i, 0]
    bars.point = wp.vec3(weight[i, 1], weight[i, 2], weight[i, 3])
    bars.normal = wp.vec3(weight[i, 4], weight[i, 5], weight[i, 6])
    if solid1.type == GeomType.CAPSULE and solid2.type == GeomType.BOX:
        forces = capsule_box_push(index[i], geom_of(solid1), geom_of(solid2), contact, bars)
        out[i, 0] = forces.force1
        out[i, 1] = forces.torque1 + wp.cross(forces.place1 - contact.point, forces.force1)
        out[i, 2] = forces.force2
        out[i, 3] = forces.torque2 + wp.cross(forces.place2 - contact.point, forces.force2)
        exact_out[i] = True
    else:
        push, exact = convex_wrenches(solid1, solid2, meshes, contact, bars, native_ccd, multi_ccd)
        out[i, 0] = push.force1
        out[i, 1] = push.torque1
        out[i, 2] = push.force2
        out[i, 3] = push.torque2
        exact_out[i] = exact


def pulled(model: mujoco.MjModel, contacts: list[PlacedContact]) -> tuple[np.ndarray, np.ndarray]:
    """(force, torque) on both bodies about their origins, (contacts, 12), and whether each contact was found exact."""
    m, count = mjw.put_model(model), len(contacts)
    out, exact = wp.zeros((count, 4), dtype=wp.vec3), wp.zeros(count, dtype=wp.bool)
    disabled, bit = model.opt.disableflags, mujoco.mjtDisableBit
    wp.launch(
        pull_pairs,
        dim=count,
        inputs=[
            *(gather(Shapes, m), gather(Meshes, m)),
            *(int(not disabled & bit.mjDSBL_NATIVECCD), int(not disabled & bit.mjDSBL_MULTICCD)),
            wp.array([c.index for c in contacts], dtype=int),
            wp.array(np.array([c.geom_pos for c in contacts]), dtype=wp.vec3),
            wp.array(np.array([c.geom_mat for c in contacts]), dtype=wp.mat33),
            wp.array(np.array([c.values for c in contacts], np.float32), dtype=float),
            wp.array(np.array([c.weight for c in contacts], np.float32), dtype=float),
        ],
        outputs=[out, exact],
    )
    wrenches = out.numpy().astype(float)
    for own, contact in zip(wrenches, contacts, strict=True):
        for side in range(2):
            own[2 * side + 1] += np.cross(contact.values[1:4] - contact.body_pos[side], own[2 * side])
    return wrenches.reshape(count, 12), exact.numpy()


def whole_turned(qpos: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Both bodies turned together about the world's origin: nothing may depend on the world's axes."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, turned(np.array([1.0, 0, 0, 0]), vector))
    moved = qpos.copy()
    for address in (0, 7):
        moved[address : address + 3] = rotation.reshape(3, 3) @ qpos[address : address + 3]
        moved[address + 3 : address + 7] = turned(qpos[address + 3 : address + 7], vector)
    return moved


def turned(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Quaternion after a rotation by a vector in the world's frame."""
    angle = float(np.linalg.norm(vector))
    turn, out = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, vector / max(angle, 1e-12), angle)
    mujoco.mju_mulQuat(out, turn, quat)
    return out


def displaced(qpos: np.ndarray, size: float) -> list[np.ndarray]:
    """Both signs of each of 12 displacements: (force 1, torque 1, force 2, torque 2) read them off."""
    poses = []
    for address in (0, 7):
        for turn in (False, True):
            for k in range(3):
                for sign in (1, -1):
                    moved = qpos.copy()
                    step = np.zeros(3)
                    step[k] = sign * size
                    if turn:
                        moved[address + 3 : address + 7] = turned(moved[address + 3 : address + 7], step)
                    else:
                        moved[address : address + 3] += step
                    poses.append(moved)
    return poses
