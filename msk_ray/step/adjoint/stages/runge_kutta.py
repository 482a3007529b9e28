"""The pullback of a substep of RK4, stage by stage.

With the stages of `rk_stages`,

    q' = q ⊕ h Σ Bᵢ wᵢ ,    v' = v + h Σ Bᵢ aᵢ ,    act' = clamp(act + h Σ Bᵢ ȧctᵢ) ,    B = (1, 2, 2, 1)/6 .

The pullback of a stage's (aᵢ, ȧctᵢ) is that of an explicit Euler substep without its change of position: α on the
velocity after it is hα on aᵢ.
"""

from typing import Any

import warp as wp

from msk_ray.step.adjoint.groups import Joints, allocate_rows
from msk_ray.step.adjoint.laws.joint_springs import log_rate_pullback
from msk_ray.step.adjoint.spatial import set_three, three
from msk_ray.step.adjoint.stages.integrate import rate_pullback, rotation_pullback
from msk_ray.step.adjoint.stages.recompute import recompute_stages
from msk_ray.step.adjoint.stages.rk_stages import (
    A,
    Activations,
    Stage,
    StageBuffers,
    act_step,
    straight_dofs,
    turning_dof,
)
from msk_ray.step.adjoint.step import StepAdjoint

wp.set_module_options({"enable_backward": False})

_B = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)


@wp.struct
class StageBars:
    """Cotangents while the stages are pulled back, in tangent coordinates."""

    qpos: wp.array2d[float]
    """Of this stage's qpos, then taken on by the stage before; (W, nv)."""
    qvel: wp.array2d[float]
    act: wp.array2d[float]
    rate: wp.array2d[float]
    """Of w."""
    turn: wp.array2d[float]
    """Of φ."""
    next_qvel: wp.array2d[float]
    """Of v' [the substep's result]."""
    next_act: wp.array2d[float]
    """Of act' before its clamp."""
    next_rate: wp.array2d[float]
    """Of h Σ Bᵢ wᵢ."""
    sum_qpos: wp.array2d[float]
    """Of the substep's start, as far as it is known."""
    sum_qvel: wp.array2d[float]
    sum_act: wp.array2d[float]


@wp.func
def log_rate_turn(phi: wp.vec3, vel: wp.vec3, bar: wp.vec3) -> wp.vec3:
    """Cotangent of φ where bar is that of Jr(φ)⁻¹ v = v + ½ φ × v + c(φ·φ) φ × (φ × v)."""
    x = wp.dot(phi, phi)
    c = 1.0 / 12.0 + x * (1.0 / 720.0 + x * (1.0 / 30240.0 + x / 1209600.0))
    bend = 1.0 / 720.0 + x * (1.0 / 15120.0 + x / 403200.0)
    if x > 1.0:
        half = 0.5 * wp.sqrt(x)
        cot = 1.0 / wp.tan(half)
        c = (1.0 - half * cot) / x
        # dc/dx of c = (1 - f)/x with f = (θ/2) cot(θ/2), θ² = x
        bend = -(0.25 * cot / half - 0.25 * (1.0 + cot * cot)) / x - c / x
    along = wp.dot(phi, vel)
    across = wp.dot(bar, phi)
    flat = wp.dot(bar, vel)
    out = 0.5 * wp.cross(vel, bar) + c * (along * bar + across * vel - 2.0 * flat * phi)
    return out + 2.0 * bend * (across * along - flat * x) * phi


@wp.kernel
def start_bars(
    # Model:
    opt_timestep: wp.array[float],
    joints: Joints,
    activations: Activations,
    # In:
    stage1: Stage,
    stage2: Stage,
    stage3: Stage,
    stage4: Stage,
    grad_qpos_in: wp.array2d[float],
    grad_qvel_in: wp.array2d[float],
    grad_act_in: wp.array2d[float],
    # Out:
    bars_out: StageBars,
) -> None:
    """Cotangents of the sums from those of the substep's results."""
    worldid, k = wp.tid()
    h = opt_timestep[worldid % opt_timestep.shape[0]]
    if k < joints.jnt_type.shape[0]:
        v = joints.jnt_dofadr[k]
        straight = straight_dofs(joints, k)
        turn = turning_dof(joints, k)
        count = straight
        for i in range(straight):
            bars_out.next_rate[worldid, v + i] = grad_qpos_in[worldid, v + i]
            bars_out.sum_qpos[worldid, v + i] = grad_qpos_in[worldid, v + i]
        if turn >= 0:
            count += 3
            mean = three(stage1.rate, worldid, turn) + 2.0 * three(stage2.rate, worldid, turn)
            mean += 2.0 * three(stage3.rate, worldid, turn) + three(stage4.rate, worldid, turn)
            phi = h * mean / 6.0
            g = three(grad_qpos_in, worldid, turn)
            back = rotation_pullback(phi, g)
            rate = rate_pullback(phi, g)
            set_three(bars_out.next_rate, worldid, turn, rate)
            set_three(bars_out.sum_qpos, worldid, turn, back)
        for i in range(count):
            j = v + i
            bars_out.next_qvel[worldid, j] = grad_qvel_in[worldid, j]
            bars_out.sum_qvel[worldid, j] = grad_qvel_in[worldid, j]
            bars_out.qpos[worldid, j] = 0.0
            bars_out.qvel[worldid, j] = 0.0
            bars_out.turn[worldid, j] = 0.0
    if k < activations.actuator_dyntype.shape[0]:
        step = act_step(activations, worldid, k, h)
        start = activations.actuator_actadr[k]
        for j in range(start, start + activations.actuator_actnum[k]):
            act_bar = grad_act_in[worldid, j]
            if activations.actuator_actlimited[k]:
                bounds = activations.actuator_actrange[worldid % activations.actuator_actrange.shape[0], k]
                slope = stage1.act_dot[worldid, j] + 2.0 * stage2.act_dot[worldid, j]
                slope += 2.0 * stage3.act_dot[worldid, j] + stage4.act_dot[worldid, j]
                after = stage1.act[worldid, j] + step * slope / 6.0
                if after < bounds[0] or after > bounds[1]:
                    act_bar = 0.0
            bars_out.next_act[worldid, j] = act_bar
            bars_out.sum_act[worldid, j] = act_bar
            bars_out.act[worldid, j] = 0.0


@wp.kernel
def enter_stage(
    # Model:
    opt_timestep: wp.array[float],
    joints: Joints,
    a: float,
    b: float,
    # In:
    rate_in: wp.array2d[float],
    # Out:
    bars_out: StageBars,
    grad_qpos_out: wp.array2d[float],
    grad_qvel_out: wp.array2d[float],
    grad_act_out: wp.array2d[float],
) -> None:
    """Cotangents of this stage's rates from those of the next one's state; threads over joints and activations."""
    worldid, k = wp.tid()
    h = opt_timestep[worldid % opt_timestep.shape[0]]
    if k < joints.jnt_type.shape[0]:
        v = joints.jnt_dofadr[k]
        straight = straight_dofs(joints, k)
        turn = turning_dof(joints, k)
        count = straight
        for i in range(straight):
            j = v + i
            bars_out.rate[worldid, j] = h * (b * bars_out.next_rate[worldid, j] + a * bars_out.qpos[worldid, j])
            bars_out.sum_qpos[worldid, j] += bars_out.qpos[worldid, j]
        if turn >= 0:
            count += 3
            phi = h * a * three(rate_in, worldid, turn)
            g = three(bars_out.qpos, worldid, turn)
            back = rotation_pullback(phi, g)
            rate = b * three(bars_out.next_rate, worldid, turn)
            rate += a * (rate_pullback(phi, g) + three(bars_out.turn, worldid, turn))
            for i in range(3):
                bars_out.rate[worldid, turn + i] = h * rate[i]
                bars_out.sum_qpos[worldid, turn + i] += back[i]
        for i in range(count):
            j = v + i
            bars_out.sum_qvel[worldid, j] += bars_out.qvel[worldid, j]
            # α: hα is the cotangent of this stage's acceleration
            alpha = b * bars_out.next_qvel[worldid, j] + a * bars_out.qvel[worldid, j]
            bars_out.qvel[worldid, j] = alpha
            grad_qvel_out[worldid, j] = alpha
            grad_qpos_out[worldid, j] = 0.0
    if k < grad_act_out.shape[1]:
        bars_out.sum_act[worldid, k] += bars_out.act[worldid, k]
        alpha = b * bars_out.next_act[worldid, k] + a * bars_out.act[worldid, k]
        bars_out.act[worldid, k] = alpha
        grad_act_out[worldid, k] = alpha


@wp.kernel
def leave_stage(
    # Model:
    opt_timestep: wp.array[float],
    joints: Joints,
    a: float,
    # In:
    grad_qpos_in: wp.array2d[float],
    grad_qvel_in: wp.array2d[float],
    grad_act_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    last_rate_in: wp.array2d[float],
    # Out:
    bars_out: StageBars,
) -> None:
    """Cotangents of this stage's state; `a` is that of the stage before, 0 for the first."""
    worldid, k = wp.tid()
    if k < joints.jnt_type.shape[0]:
        v = joints.jnt_dofadr[k]
        straight = straight_dofs(joints, k)
        turn = turning_dof(joints, k)
        for i in range(straight):
            j = v + i
            bars_out.qpos[worldid, j] = grad_qpos_in[worldid, j]
            bars_out.qvel[worldid, j] = grad_qvel_in[worldid, j] - bars_out.qvel[worldid, j] + bars_out.rate[worldid, j]
        if turn >= 0:
            phi = wp.vec3(0.0)
            if a != 0.0:
                phi = opt_timestep[worldid % opt_timestep.shape[0]] * a * three(last_rate_in, worldid, turn)
            bar = three(bars_out.rate, worldid, turn)
            back = log_rate_pullback(phi, bar)
            slope = log_rate_turn(phi, three(qvel_in, worldid, turn), bar)
            for i in range(3):
                j = turn + i
                bars_out.qpos[worldid, j] = grad_qpos_in[worldid, j]
                bars_out.qvel[worldid, j] = grad_qvel_in[worldid, j] - bars_out.qvel[worldid, j] + back[i]
                bars_out.turn[worldid, j] = slope[i]
    if k < grad_act_in.shape[1]:
        bars_out.act[worldid, k] = grad_act_in[worldid, k] - bars_out.act[worldid, k]


@wp.kernel
def finish_bars(
    # In:
    live_in: wp.array[int],
    bars_in: StageBars,
    # Out:
    grad_qpos_out: wp.array2d[float],
    grad_qvel_out: wp.array2d[float],
    grad_act_out: wp.array2d[float],
) -> None:
    """The sums, with the first stage, whose state is the substep's own; zeros where no gradient is wanted."""
    worldid, k = wp.tid()
    live = live_in[worldid] != 0
    if k < grad_qvel_out.shape[1]:
        grad_qpos_out[worldid, k] = wp.where(live, bars_in.sum_qpos[worldid, k] + bars_in.qpos[worldid, k], 0.0)
        grad_qvel_out[worldid, k] = wp.where(live, bars_in.sum_qvel[worldid, k] + bars_in.qvel[worldid, k], 0.0)
    if k < grad_act_out.shape[1]:
        grad_act_out[worldid, k] = wp.where(live, bars_in.sum_act[worldid, k] + bars_in.act[worldid, k], 0.0)


class RungeKutta:
    """Launches of the pullback of one substep of RK4.

    Args:
        adjoint: the pullback of a single stage, whose cotangents are those of the substep.
    """

    def __init__(self, adjoint: StepAdjoint) -> None:
        self._adjoint, self._work = adjoint, adjoint.work
        work = adjoint.work
        with wp.ScopedDevice(work.device):
            self._stages = StageBuffers(work)
            widths = dict.fromkeys(("act", "next_act", "sum_act"), work.mjm.na)
            self._bars = allocate_rows(StageBars, work.nworld, widths, work.mjm.nv)

    def pull_back(self, data: Any, qvel_next: wp.array, *extras: Any) -> None:
        """Launch the pullback of one substep.

        Args:
            data: the state before it in qpos, qvel and act, and a guess of the acceleration in qacc.
            qvel_next: not read; positions follow the mean of the stages' velocities.
            extras: further gradients that a StepAdjoint's `pull_back` takes.
        """
        adjoint, work, m = self._adjoint, self._work, self._work.model
        stages = self._stages.items
        self._stages.launch(data)
        named = {f"stage{k + 1}": stage for k, stage in enumerate(stages)}
        work.launch(start_bars, (work.nworld, max(m.njnt, m.nactuator)), None, self._bars, **named)
        shape = (work.nworld, max(m.njnt, work.mjm.na))
        counted = adjoint.touch_counter.substep
        for k in reversed(range(4)):
            if k < 3:
                self._stages.restore(k, data)
                recompute_stages(work.mjm, m, data, work.stages)
            work.launch(enter_stage, shape, None, self._bars, a=A[k] if k < 3 else 0.0, b=_B[k], rate=stages[k].rate)
            adjoint.touch_counter.substep = counted  # the stages of a substep count as one
            adjoint.pull_back(data, data.qvel, *extras)
            last = {"a": A[k - 1], "last_rate": stages[k - 1].rate} if k else {"a": 0.0, "last_rate": stages[0].rate}
            work.launch(leave_stage, shape, None, self._bars, qvel=stages[k].qvel, **last)
        work.launch(finish_bars, (work.nworld, max(work.mjm.nv, work.mjm.na)), None, self._bars)
