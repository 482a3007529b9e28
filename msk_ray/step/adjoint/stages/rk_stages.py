"""The four stages of a substep of RK4, computed once more: mujoco_warp keeps none of them.

With wᵢ the rate of the rotation vector φᵢ of stage i (wᵢ = vᵢ for hinges and slides, Jr(φᵢ)⁻¹ vᵢ for turning joints):

    qᵢ₊₁ = q ⊕ h Aᵢ wᵢ ,  vᵢ₊₁ = v + h Aᵢ aᵢ ,  actᵢ₊₁ = act + h Aᵢ ȧctᵢ ,  φᵢ₊₁ = h Aᵢ wᵢ ,  A = (½, ½, 1)
"""

from typing import Any

import mujoco_warp as mjw
import warp as wp
from mujoco_warp import DynType, JointType

from msk_ray.step.adjoint.groups import Joints, allocate_rows
from msk_ray.step.adjoint.spatial import four, set_three, three
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import deriv_expmap, quat_integrate, vec10

wp.set_module_options({"enable_backward": False})

A = (0.5, 0.5, 1.0)
"""Share of the substep after which stages 2 to 4 lie."""


@wp.struct
class Activations:
    """Dynamics of actuators with a state."""

    actuator_dyntype: wp.array[int]
    actuator_actadr: wp.array[int]
    actuator_actnum: wp.array[int]
    actuator_actlimited: wp.array[bool]
    actuator_dynprm: wp.array2d[vec10]
    actuator_actrange: wp.array2d[wp.vec2]


@wp.struct
class Stage:
    """One stage's state and rates."""

    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    act: wp.array2d[float]
    qacc: wp.array2d[float]
    rate: wp.array2d[float]
    """w, shape (W, nv)."""
    act_dot: wp.array2d[float]


@wp.func
def turning_dof(joints: Joints, jnt: int) -> int:
    """First of a joint's three rotational dofs, -1 for hinges and slides."""
    kind = joints.jnt_type[jnt]
    dof = joints.jnt_dofadr[jnt]
    if kind == JointType.FREE:
        return dof + 3
    if kind == JointType.BALL:
        return dof
    return -1


@wp.func
def straight_dofs(joints: Joints, jnt: int) -> int:
    """How many of a joint's dofs, from its first, add up as numbers."""
    kind = joints.jnt_type[jnt]
    if kind == JointType.FREE:
        return 3
    if kind == JointType.BALL:
        return 0
    return 1


@wp.func
def act_step(activations: Activations, worldid: int, uid: int, h: float) -> float:
    """How long ȧct acts: h, or less where the filter is integrated exactly."""
    if activations.actuator_dyntype[uid] != DynType.FILTEREXACT:
        return h
    tau = wp.max(activations.actuator_dynprm[worldid % activations.actuator_dynprm.shape[0], uid][0], 1.0e-15)
    return tau * (1.0 - wp.exp(-h / tau))


@wp.kernel
def next_stage(
    # Model:
    opt_timestep: wp.array[float],
    joints: Joints,
    activations: Activations,
    a: float,
    # In:
    first_in: Stage,
    last_in: Stage,
    # Out:
    qpos_out: wp.array2d[float],
    qvel_out: wp.array2d[float],
    act_out: wp.array2d[float],
) -> None:
    """State of the next stage from the first and the last; threads over joints and actuators."""
    worldid, k = wp.tid()
    h = opt_timestep[worldid % opt_timestep.shape[0]]
    if k < joints.jnt_type.shape[0]:
        turn = turning_dof(joints, k)
        q = joints.jnt_qposadr[k]
        v = joints.jnt_dofadr[k]
        straight = straight_dofs(joints, k)
        for i in range(straight):
            qpos_out[worldid, q + i] = first_in.qpos[worldid, q + i] + h * a * last_in.rate[worldid, v + i]
            qvel_out[worldid, v + i] = first_in.qvel[worldid, v + i] + h * a * last_in.qacc[worldid, v + i]
        if turn >= 0:
            q += straight
            quat = four(first_in.qpos, worldid, q)
            quat = quat_integrate(quat, a * three(last_in.rate, worldid, turn), h)
            for i in range(4):
                qpos_out[worldid, q + i] = quat[i]
            qvel = three(first_in.qvel, worldid, turn) + h * a * three(last_in.qacc, worldid, turn)
            set_three(qvel_out, worldid, turn, qvel)
    if k < activations.actuator_dyntype.shape[0]:
        step = act_step(activations, worldid, k, h)
        start = activations.actuator_actadr[k]
        for j in range(start, start + activations.actuator_actnum[k]):
            act_out[worldid, j] = first_in.act[worldid, j] + step * a * last_in.act_dot[worldid, j]


@wp.kernel
def stage_rates(
    # Model:
    opt_timestep: wp.array[float],
    joints: Joints,
    a: float,
    # In:
    qvel_in: wp.array2d[float],
    last_rate_in: wp.array2d[float],
    # Out:
    rate_out: wp.array2d[float],
) -> None:
    """w of a stage; `a` is 0 for the first one, whose rotation vector is zero."""
    worldid, jnt = wp.tid()
    v = joints.jnt_dofadr[jnt]
    for i in range(straight_dofs(joints, jnt)):
        rate_out[worldid, v + i] = qvel_in[worldid, v + i]
    turn = turning_dof(joints, jnt)
    if turn >= 0:
        phi = wp.vec3(0.0)
        if a != 0.0:
            phi = opt_timestep[worldid % opt_timestep.shape[0]] * a * three(last_rate_in, worldid, turn)
        rate = deriv_expmap(phi, three(qvel_in, worldid, turn))
        set_three(rate_out, worldid, turn, rate)


class StageBuffers:
    """Buffers of the four stages, and the launches that fill them.

    Attributes:
        items: the stages.
    """

    def __init__(self, work: Workspace) -> None:
        self._work = work
        widths = {"qpos": work.mjm.nq, "act": work.mjm.na, "act_dot": work.mjm.na}
        self.items = [allocate_rows(Stage, work.nworld, widths, work.mjm.nv) for _ in range(4)]

    def launch(self, data: Any) -> None:
        """Launch all four from the state in `data`, which then holds the last; its qacc starts the first solve."""
        work, m, first = self._work, self._work.model, self.items[0]
        threads = max(m.njnt, m.nactuator)
        wp.copy(data.qacc_warmstart, data.qacc)
        for k, stage in enumerate(self.items):
            a, last = (A[k - 1], self.items[k - 1]) if k else (0.0, first)
            if k:
                state = {"qpos": data.qpos, "qvel": data.qvel, "act": data.act}
                work.launch(next_stage, (work.nworld, threads), None, a=a, first=first, last=last, **state)
            mjw.forward(m, data)
            for name in ("qpos", "qvel", "act", "qacc", "act_dot"):
                wp.copy(getattr(stage, name), getattr(data, name))
            rates = {"qvel": data.qvel, "last_rate": last.rate, "rate": stage.rate}
            work.launch(stage_rates, (work.nworld, m.njnt), None, a=a, **rates)

    def restore(self, k: int, data: Any) -> None:
        """Launch the copy of a stage's state and acceleration into `data`."""
        for name in ("qpos", "qvel", "act", "qacc"):
            wp.copy(getattr(data, name), getattr(self.items[k], name))
