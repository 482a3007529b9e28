"""Tangent-space arithmetic on batched qpos: MuJoCo's mj_integratePos and mj_differentiatePos in torch.

Rotations are perturbed in the local (body) frame, as MuJoCo's ball and free joint velocities are.
"""

import mujoco
import torch
from torch import Tensor

from msk_ray.step.adjoint.stages.integrate import UNIT_ROUNDING


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product of quaternions (w, x, y, z), shape (..., 4)."""
    # By vectors and not by components, because each operation is a kernel of its own on a GPU.
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    w = aw * bw - (av * bv).sum(-1, keepdim=True)
    return torch.cat((w, aw * bv + bw * av + torch.linalg.cross(av, bv)), dim=-1)


def quat_conjugate(q: Tensor) -> Tensor:
    """Inverse rotation, shape (..., 4)."""
    return torch.cat((q[..., :1], -q[..., 1:]), dim=-1)


def quat_exp(rotation: Tensor) -> Tensor:
    """Unit quaternion of a rotation vector [rad], shape (..., 3) to (..., 4)."""
    half = 0.5 * rotation
    angle = half.norm(dim=-1, keepdim=True)
    # torch.sinc(x) is sin(πx)/(πx), exact at zero.
    return torch.cat((torch.cos(angle), torch.sinc(angle / torch.pi) * half), dim=-1)


def quat_log(q: Tensor) -> Tensor:
    """Rotation vector [rad] of a unit quaternion, |angle| ≤ π, shape (..., 4) to (..., 3)."""
    q = torch.where(q[..., :1] < 0, -q, q)
    w, v = q[..., :1], q[..., 1:]
    sin = v.norm(dim=-1, keepdim=True)
    # angle / sin(angle/2) → 2 / w as the rotation → 0.
    scale = torch.where(sin > 1e-8, 2.0 * torch.atan2(sin, w) / sin.clamp_min(1e-8), 2.0 / w.clamp_min(0.5))
    return scale * v


def quat_rotate(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors (..., 3) from the local frame of q (..., 4) to its parent's."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * torch.linalg.cross(u, v)
    return v + w * t + torch.linalg.cross(u, t)


def quat_yaw(q: Tensor) -> Tensor:
    """Angle [rad] in the plane x, y of the x axis turned by q, shape (..., 4) to (...)."""
    w, x, y, z = q.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


class Tangent:
    """Tangent-space arithmetic for a model: maps joints between qpos (nq) and the tangent space (nv)."""

    def __init__(self, model: mujoco.MjModel, device: torch.device) -> None:
        self.nq, self.nv = model.nq, model.nv
        linear_q: list[int] = []
        linear_v: list[int] = []
        self._rotations: list[tuple[slice, slice]] = []
        for joint in range(model.njnt):
            kind = model.jnt_type[joint]
            q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                linear_q += [q, q + 1, q + 2]
                linear_v += [v, v + 1, v + 2]
                self._rotations.append((slice(q + 3, q + 7), slice(v + 3, v + 6)))
            elif kind == mujoco.mjtJoint.mjJNT_BALL:
                self._rotations.append((slice(q, q + 4), slice(v, v + 3)))
            else:
                linear_q.append(q)
                linear_v.append(v)
        self._linear_q = torch.tensor(linear_q, dtype=torch.long, device=device)
        self._linear_v = torch.tensor(linear_v, dtype=torch.long, device=device)

    def integrate(self, qpos: Tensor, delta: Tensor) -> Tensor:
        """qpos ⊕ delta, shapes (..., nq) and (..., nv)."""
        out = qpos.clone()
        out[..., self._linear_q] += delta[..., self._linear_v]
        for q, v in self._rotations:
            out[..., q] = quat_multiply(qpos[..., q], quat_exp(delta[..., v]))
        return out

    def difference(self, start: Tensor, end: Tensor) -> Tensor:
        """The delta (..., nv) with start ⊕ delta = end."""
        out = start.new_empty((*start.shape[:-1], self.nv))
        out[..., self._linear_v] = (end - start)[..., self._linear_q]
        for q, v in self._rotations:
            out[..., v] = quat_log(quat_multiply(quat_conjugate(start[..., q]), end[..., q]))
        return out

    def project(self, qpos: Tensor, gradient: Tensor) -> Tensor:
        """Gradient in raw coordinates (..., nq) to tangent coordinates (..., nv).

        d(q⊗exp(δ))/dδ at 0 is ½ q⊗[0, ·], so the tangent gradient is the vector part of ½ q*⊗g.
        """
        out = gradient.new_empty((*gradient.shape[:-1], self.nv))
        out[..., self._linear_v] = gradient[..., self._linear_q]
        for q, v in self._rotations:
            out[..., v] = 0.5 * quat_multiply(quat_conjugate(qpos[..., q]), gradient[..., q])[..., 1:]
        return out

    def lift(self, qpos: Tensor, gradient: Tensor) -> Tensor:
        """Gradient in tangent coordinates (..., nv) to raw ones (..., nq) without a component along q, for functions
        that normalise quaternions: 2 q⊗[0, g] / |q|².
        """
        out = gradient.new_zeros((*gradient.shape[:-1], self.nq))
        out[..., self._linear_q] = gradient[..., self._linear_v]
        for q, v in self._rotations:
            pure = torch.cat((torch.zeros_like(gradient[..., v][..., :1]), gradient[..., v]), dim=-1)
            square = qpos[..., q].square().sum(-1, keepdim=True)
            unit = (square - 1.0).abs() <= UNIT_ROUNDING
            out[..., q] = 2.0 * quat_multiply(qpos[..., q], torch.where(unit, pure, pure / square))
        return out
