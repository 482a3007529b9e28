"""Poses and velocities of all bodies as functions of (qpos, qvel), and their pullback by Warp's own differentiation.

The chain of frames from the world to each body is cut into steps: one that goes from a body's parent to where the body
would be without its joints, and one for each joint. Every step reads the frame before it and writes its own place in
the arrays, so that one thread walks a world's steps in order and nothing that its adjoint needs is overwritten.

Axes: W worlds, S frames, the world's own first.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
import warp as wp

PLACE = wp.constant(0)
FREE = wp.constant(1)
BALL = wp.constant(2)
SLIDE = wp.constant(3)
HINGE = wp.constant(4)

_KIND = {
    mujoco.mjtJoint.mjJNT_FREE: 1,
    mujoco.mjtJoint.mjJNT_BALL: 2,
    mujoco.mjtJoint.mjJNT_SLIDE: 3,
    mujoco.mjtJoint.mjJNT_HINGE: 4,
}


@wp.kernel
def walk_frames(
    # Model:
    step_kind: wp.array[int],
    step_parent: wp.array[int],
    step_offset: wp.array[wp.vec3],
    step_quat: wp.array[wp.quat],
    step_axis: wp.array[wp.vec3],
    step_reference: wp.array[float],
    step_qposadr: wp.array[int],
    step_dofadr: wp.array[int],
    # In:
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    # Out:
    pos_out: wp.array2d[wp.vec3],
    quat_out: wp.array2d[wp.quat],
    linvel_out: wp.array2d[wp.vec3],
    angvel_out: wp.array2d[wp.vec3],
) -> None:
    """Frame s + 1 from step s; frame 0 is the world and has been written by the host."""
    worldid = wp.tid()
    for s in range(step_kind.shape[0]):
        kind = step_kind[s]
        p = step_parent[s]
        pos = pos_out[worldid, p]
        quat = quat_out[worldid, p]
        linvel = linvel_out[worldid, p]
        angvel = angvel_out[worldid, p]
        qadr = step_qposadr[s]
        vadr = step_dofadr[s]
        if kind == PLACE:
            arm = wp.quat_rotate(quat, step_offset[s])
            pos_out[worldid, s + 1] = pos + arm
            quat_out[worldid, s + 1] = quat * step_quat[s]
            linvel_out[worldid, s + 1] = linvel + wp.cross(angvel, arm)
            angvel_out[worldid, s + 1] = angvel
        elif kind == FREE:
            # qpos holds (w, x, y, z), wp.quat (x, y, z, w).
            turned = wp.normalize(
                wp.quat(
                    qpos_in[worldid, qadr + 4],
                    qpos_in[worldid, qadr + 5],
                    qpos_in[worldid, qadr + 6],
                    qpos_in[worldid, qadr + 3],
                )
            )
            pos_out[worldid, s + 1] = wp.vec3(
                qpos_in[worldid, qadr], qpos_in[worldid, qadr + 1], qpos_in[worldid, qadr + 2]
            )
            quat_out[worldid, s + 1] = turned
            linvel_out[worldid, s + 1] = wp.vec3(
                qvel_in[worldid, vadr], qvel_in[worldid, vadr + 1], qvel_in[worldid, vadr + 2]
            )
            # The angular velocity of a free joint is in the body's own frame.
            angvel_out[worldid, s + 1] = wp.quat_rotate(
                turned, wp.vec3(qvel_in[worldid, vadr + 3], qvel_in[worldid, vadr + 4], qvel_in[worldid, vadr + 5])
            )
        elif kind == SLIDE:
            axis = wp.quat_rotate(quat, step_axis[s])
            travel = (qpos_in[worldid, qadr] - step_reference[s]) * axis
            pos_out[worldid, s + 1] = pos + travel
            quat_out[worldid, s + 1] = quat
            linvel_out[worldid, s + 1] = linvel + wp.cross(angvel, travel) + qvel_in[worldid, vadr] * axis
            angvel_out[worldid, s + 1] = angvel
        elif kind == HINGE:
            # The anchor stays, and the body turns about it.
            arm = wp.quat_rotate(quat, step_offset[s])
            turned = quat * wp.quat_from_axis_angle(step_axis[s], qpos_in[worldid, qadr] - step_reference[s])
            back = wp.quat_rotate(turned, step_offset[s])
            spin = angvel + qvel_in[worldid, vadr] * wp.quat_rotate(quat, step_axis[s])
            pos_out[worldid, s + 1] = pos + arm - back
            quat_out[worldid, s + 1] = turned
            linvel_out[worldid, s + 1] = linvel + wp.cross(angvel, arm) - wp.cross(spin, back)
            angvel_out[worldid, s + 1] = spin
        elif kind == BALL:
            arm = wp.quat_rotate(quat, step_offset[s])
            turned = quat * wp.normalize(
                wp.quat(
                    qpos_in[worldid, qadr + 1],
                    qpos_in[worldid, qadr + 2],
                    qpos_in[worldid, qadr + 3],
                    qpos_in[worldid, qadr],
                )
            )
            back = wp.quat_rotate(turned, step_offset[s])
            spin = angvel + wp.quat_rotate(
                turned, wp.vec3(qvel_in[worldid, vadr], qvel_in[worldid, vadr + 1], qvel_in[worldid, vadr + 2])
            )
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
        kinds, parents, offsets, quats, axes, references, qposadrs, dofadrs = ([] for _ in range(8))
        self.body_frame = np.zeros(mjm.nbody, dtype=np.int64)

        def step(kind: int, parent: int, offset: object, quat: object, axis: object, joint: int | None) -> int:
            kinds.append(kind)
            parents.append(parent)
            offsets.append(offset)
            quats.append(quat)
            axes.append(axis)
            references.append(0.0 if joint is None or kind not in (3, 4) else mjm.qpos0[mjm.jnt_qposadr[joint]])
            qposadrs.append(0 if joint is None else mjm.jnt_qposadr[joint])
            dofadrs.append(0 if joint is None else mjm.jnt_dofadr[joint])
            return len(kinds)

        none = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0)
        for body in range(1, mjm.nbody):
            frame = int(self.body_frame[mjm.body_parentid[body]])
            joints = range(mjm.body_jntadr[body], mjm.body_jntadr[body] + mjm.body_jntnum[body])
            if not any(mjm.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE for j in joints):
                w, x, y, z = mjm.body_quat[body]
                frame = step(0, frame, mjm.body_pos[body], (x, y, z, w), none[2], None)
            for j in joints:
                kind = _KIND[mujoco.mjtJoint(mjm.jnt_type[j])]
                frame = step(kind, frame, mjm.jnt_pos[j], none[1], mjm.jnt_axis[j], j)
            self.body_frame[body] = frame
        self._nworld, self._device = nworld, device
        with wp.ScopedDevice(device):
            self._model = [
                wp.array(np.asarray(kinds, np.int32), dtype=int),
                wp.array(np.asarray(parents, np.int32), dtype=int),
                wp.array(np.asarray(offsets, np.float32).reshape(-1, 3), dtype=wp.vec3),
                wp.array(np.asarray(quats, np.float32).reshape(-1, 4), dtype=wp.quat),
                wp.array(np.asarray(axes, np.float32).reshape(-1, 3), dtype=wp.vec3),
                wp.array(np.asarray(references, np.float32), dtype=float),
                wp.array(np.asarray(qposadrs, np.int32), dtype=int),
                wp.array(np.asarray(dofadrs, np.int32), dtype=int),
            ]
            self.qpos = wp.zeros((nworld, mjm.nq), dtype=float)
            self.qvel = wp.zeros((nworld, mjm.nv), dtype=float)
            self.grad_qpos, self.grad_qvel = wp.zeros_like(self.qpos), wp.zeros_like(self.qvel)
            self.frames = FrameArrays.zeros(nworld, len(kinds) + 1)
            self.bars = FrameArrays.zeros(nworld, len(kinds) + 1)
        world = np.zeros((nworld, len(kinds) + 1, 4), np.float32)
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
        """Launch `grad_qpos` and `grad_qvel` of `bars` at `qpos` and `qvel`."""
        self.launch_forward()
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
