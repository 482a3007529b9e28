"""Poses and velocities of all bodies as functions of (qpos, qvel), and their pullback by Warp's own differentiation.

The chain of frames from the world to each body is cut into links: one that goes from a body's parent to where the body
would be without its joints, and one for each joint. Every link reads the frame before it and writes its own place in
the arrays, so that one thread walks a world's links in order and nothing that its adjoint needs is overwritten.

Axes: W worlds, S frames, the world's own first.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import warp as wp

from msk_ray.step.adjoint.spatial import three

PLACE = wp.constant(0)
FREE = wp.constant(1)
BALL = wp.constant(2)
SLIDE = wp.constant(3)
HINGE = wp.constant(4)

_KIND = {
    mujoco.mjtJoint.mjJNT_FREE: FREE,
    mujoco.mjtJoint.mjJNT_BALL: BALL,
    mujoco.mjtJoint.mjJNT_SLIDE: SLIDE,
    mujoco.mjtJoint.mjJNT_HINGE: HINGE,
}


@wp.func
def quat_at(qpos: wp.array2d[float], worldid: int, first: int) -> wp.quat:
    """Unit quaternion of a row; qpos holds (w, x, y, z), wp.quat (x, y, z, w)."""
    u = three(qpos, worldid, first + 1)
    return wp.normalize(wp.quat(u[0], u[1], u[2], qpos[worldid, first]))


@wp.kernel
def walk_frames(
    # Model:
    link_kind: wp.array[int],
    link_parent: wp.array[int],
    link_offset: wp.array[wp.vec3],
    link_quat: wp.array[wp.quat],
    link_axis: wp.array[wp.vec3],
    link_reference: wp.array[float],
    link_qposadr: wp.array[int],
    link_dofadr: wp.array[int],
    # In:
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    # Out:
    pos_out: wp.array2d[wp.vec3],
    quat_out: wp.array2d[wp.quat],
    linvel_out: wp.array2d[wp.vec3],
    angvel_out: wp.array2d[wp.vec3],
) -> None:
    """Frame s + 1 from link s; frame 0 is the world and has been written by the host."""
    worldid = wp.tid()
    for s in range(link_kind.shape[0]):
        kind = link_kind[s]
        p = link_parent[s]
        pos = pos_out[worldid, p]
        quat = quat_out[worldid, p]
        linvel = linvel_out[worldid, p]
        angvel = angvel_out[worldid, p]
        qadr = link_qposadr[s]
        vadr = link_dofadr[s]
        if kind == PLACE:
            arm = wp.quat_rotate(quat, link_offset[s])
            pos_out[worldid, s + 1] = pos + arm
            quat_out[worldid, s + 1] = quat * link_quat[s]
            linvel_out[worldid, s + 1] = linvel + wp.cross(angvel, arm)
            angvel_out[worldid, s + 1] = angvel
        elif kind == FREE:
            turned = quat_at(qpos_in, worldid, qadr + 3)
            pos_out[worldid, s + 1] = three(qpos_in, worldid, qadr)
            quat_out[worldid, s + 1] = turned
            linvel_out[worldid, s + 1] = three(qvel_in, worldid, vadr)
            # The angular velocity of a free joint is in the body's own frame.
            angvel_out[worldid, s + 1] = wp.quat_rotate(turned, three(qvel_in, worldid, vadr + 3))
        elif kind == SLIDE:
            axis = wp.quat_rotate(quat, link_axis[s])
            travel = (qpos_in[worldid, qadr] - link_reference[s]) * axis
            pos_out[worldid, s + 1] = pos + travel
            quat_out[worldid, s + 1] = quat
            linvel_out[worldid, s + 1] = linvel + wp.cross(angvel, travel) + qvel_in[worldid, vadr] * axis
            angvel_out[worldid, s + 1] = angvel
        elif kind == HINGE:
            # The anchor stays, and the body turns about it.
            arm = wp.quat_rotate(quat, link_offset[s])
            turned = quat * wp.quat_from_axis_angle(link_axis[s], qpos_in[worldid, qadr] - link_reference[s])
            back = wp.quat_rotate(turned, link_offset[s])
            spin = angvel + qvel_in[worldid, vadr] * wp.quat_rotate(quat, link_axis[s])
            pos_out[worldid, s + 1] = pos + arm - back
            quat_out[worldid, s + 1] = turned
            linvel_out[worldid, s + 1] = linvel + wp.cross(angvel, arm) - wp.cross(spin, back)
            angvel_out[worldid, s + 1] = spin
        elif kind == BALL:
            arm = wp.quat_rotate(quat, link_offset[s])
            turned = quat * quat_at(qpos_in, worldid, qadr)
            back = wp.quat_rotate(turned, link_offset[s])
            spin = angvel + wp.quat_rotate(turned, three(qvel_in, worldid, vadr))
            pos_out[worldid, s + 1] = pos + arm - back
            quat_out[worldid, s + 1] = turned
            linvel_out[worldid, s + 1] = linvel + wp.cross(angvel, arm) - wp.cross(spin, back)
            angvel_out[worldid, s + 1] = spin


@dataclass(frozen=True)
class FrameArrays:
    """Frames of all worlds, each (W, S), in world coordinates."""

    pos: wp.array
    """Origin [m], vec3."""
    quat: wp.array
    """Orientation, quat (x, y, z, w)."""
    linvel: wp.array
    """Velocity of the origin [m/s], vec3."""
    angvel: wp.array
    """Angular velocity [rad/s], vec3."""

    @staticmethod
    def zeros(nworld: int, frames: int) -> "FrameArrays":
        """Arrays of `frames` frames on the current device; all zero, the orientations too."""
        shape = (nworld, frames)
        return FrameArrays(
            wp.zeros(shape, dtype=wp.vec3),
            wp.zeros(shape, dtype=wp.quat),
            wp.zeros(shape, dtype=wp.vec3),
            wp.zeros(shape, dtype=wp.vec3),
        )

    def __iter__(self) -> Iterator[wp.array]:
        return iter((self.pos, self.quat, self.linvel, self.angvel))


def _device_array(values: Sequence[Any], dtype: Any) -> wp.array:
    width = wp.types.type_size(dtype)
    host = np.asarray(values, np.int32 if dtype is int else np.float32)
    return wp.array(host.reshape((-1, width) if width > 1 else -1), dtype=dtype)


class FrameWalk:
    """Launches that take (qpos, qvel) to the frames of all bodies, and cotangents of the frames back.

    Args:
        mjm: the model.
        nworld: number of worlds W.
        device: the Warp device.

    Attributes:
        body_frame: for each body the frame that is its own, shape (nbody,).
        qpos, qvel: inputs, (W, nq) and (W, nv).
        frames, bars: results and their cotangents; a pullback consumes the cotangents.
        grad_qpos, grad_qvel: gradients in raw coordinates, (W, nq) and (W, nv).
    """

    def __init__(self, mjm: mujoco.MjModel, nworld: int, device: wp.Device) -> None:
        links: list[tuple[Any, ...]] = []  # in the order of the kernel's arguments
        self.body_frame = np.zeros(mjm.nbody, dtype=np.int64)
        rest, up = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0)
        for body in range(1, mjm.nbody):
            frame = int(self.body_frame[mjm.body_parentid[body]])
            joints = range(mjm.body_jntadr[body], mjm.body_jntadr[body] + mjm.body_jntnum[body])
            if not any(mjm.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE for j in joints):
                w, x, y, z = mjm.body_quat[body]
                links.append((PLACE, frame, mjm.body_pos[body], (x, y, z, w), up, 0.0, 0, 0))
                frame = len(links)
            for j in joints:
                kind, qposadr = _KIND[mujoco.mjtJoint(mjm.jnt_type[j])], mjm.jnt_qposadr[j]
                reference = mjm.qpos0[qposadr] if kind in (SLIDE, HINGE) else 0.0
                addresses = (qposadr, mjm.jnt_dofadr[j])
                links.append((kind, frame, mjm.jnt_pos[j], rest, mjm.jnt_axis[j], reference, *addresses))
                frame = len(links)
            self.body_frame[body] = frame
        self._nworld, self._device = nworld, device
        with wp.ScopedDevice(device):
            dtypes = (int, int, wp.vec3, wp.quat, wp.vec3, float, int, int)
            columns = zip(*links, strict=True) if links else [()] * len(dtypes)
            self._model = [_device_array(values, dtype) for values, dtype in zip(columns, dtypes, strict=True)]
            self.qpos = wp.zeros((nworld, mjm.nq), dtype=float)
            self.qvel = wp.zeros((nworld, mjm.nv), dtype=float)
            self.grad_qpos, self.grad_qvel = wp.zeros_like(self.qpos), wp.zeros_like(self.qvel)
            self.frames = FrameArrays.zeros(nworld, len(links) + 1)
            self.bars = FrameArrays.zeros(nworld, len(links) + 1)
        world = np.zeros((nworld, len(links) + 1, 4), np.float32)
        world[:, 0, 3] = 1.0
        self.frames.quat.assign(world)

    def launch_forward(self) -> None:
        """Launch `frames` of `qpos` and `qvel`."""
        wp.launch(
            walk_frames,
            dim=self._nworld,
            inputs=[*self._model, self.qpos, self.qvel],
            outputs=[*self.frames],
            device=self._device,
        )

    def launch_pullback(self) -> None:
        """Launch `grad_qpos` and `grad_qvel` of `bars` at `qpos` and `qvel`, whose `frames` are there already."""
        self.grad_qpos.zero_()
        self.grad_qvel.zero_()
        wp.launch(
            walk_frames,
            dim=self._nworld,
            inputs=[*self._model, self.qpos, self.qvel],
            outputs=[*self.frames],
            adj_inputs=[None] * len(self._model) + [self.grad_qpos, self.grad_qvel],
            adj_outputs=[*self.bars],
            adjoint=True,
            device=self._device,
        )
