"""Actuators: slopes of force and activation by control, activation, length, velocity and the actuator's parameters.

With m the moment, ρ(x) = m·x and κ = Σ m_i m_j μ_i â_j over the pairs of dofs that M couples,

    Φ ∋ -ρ(λ) F(len, ρ(v), act, ctrl) - h κ ∂F/∂v (with implicit integration) ,  act' = act + h · rate(act, ctrl)
    F = gain(len, v) · drive + bias(len, v)   clamped; drive is the clamped control, act or act'.

`actuator_potential` is that law, act' included, and Warp differentiates it once, in `pull_actuators`: for the state,
and for the law's own parameters if their gradients are wanted.
"""

from functools import cache
from typing import Any

import warp as wp
from mujoco_warp import BiasType, DynType, GainType, JointType, TrnType

from msk_ray.step.adjoint.groups import DofSlopes, Multipliers, State, Substep, TendonBars, TimestepGradient, allocate
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import muscle_bias, muscle_dynamics, muscle_gain, muscle_gain_vel_deriv, vec10
from msk_ray.step.forward.model_tree import motors_apart

wp.set_module_options({"enable_backward": False})

_MINVAL = wp.constant(1.0e-15)


@wp.struct
class ActuatorLaw:
    """What one actuator's force and activation depend on besides (ctrl, act, length, velocity)."""

    dyntype: int
    gaintype: int
    biastype: int
    early: int
    clamp_ctrl: int
    clamp_act: int
    clamp_next: int
    clamp_force: int
    implicit: int
    dynprm: vec10
    gainprm: vec10
    biasprm: vec10
    ctrlrange: wp.vec2
    actrange: wp.vec2
    forcerange: wp.vec2
    lengthrange: wp.vec2
    acc0: float
    timestep: float


@wp.func
def free_activation(law: ActuatorLaw, ctrl: wp.float32, act: wp.float32) -> wp.float32:
    """act' of a stateful actuator before its own clamp, from the control after its clamp."""
    rate = wp.float32(0.0)
    step = law.timestep
    if law.dyntype == DynType.INTEGRATOR:
        rate = ctrl
    elif law.dyntype == DynType.MUSCLE:
        rate = muscle_dynamics(ctrl, act, law.dynprm)
    else:
        tau = wp.max(law.dynprm[0], _MINVAL)
        rate = (ctrl - act) / tau
        if law.dyntype == DynType.FILTEREXACT:
            step = tau * (1.0 - wp.exp(-law.timestep / tau))
    return act + step * rate


@wp.func
def actuator_force(law: ActuatorLaw, drive: wp.float32, length: wp.float32, velocity: wp.float32) -> wp.float32:
    """Scalar force: gain(length, velocity)·drive + bias(length, velocity), clamped."""
    gain = law.gainprm[0]
    if law.gaintype == GainType.AFFINE:
        gain = law.gainprm[0] + law.gainprm[1] * length + law.gainprm[2] * velocity
    elif law.gaintype == GainType.MUSCLE:
        gain = muscle_gain(length, velocity, law.lengthrange, law.acc0, law.gainprm)
    bias = wp.float32(0.0)
    if law.biastype == BiasType.AFFINE:
        bias = law.biasprm[0] + law.biasprm[1] * length + law.biasprm[2] * velocity
    elif law.biastype == BiasType.MUSCLE:
        bias = muscle_bias(length, law.lengthrange, law.acc0, law.biasprm)
    force = gain * drive + bias
    if law.clamp_force == 1:
        force = wp.clamp(force, law.forcerange[0], law.forcerange[1])
    return force


@wp.func
def force_velocity_slope(
    law: ActuatorLaw, ctrl: wp.float32, drive: wp.float32, length: wp.float32, velocity: wp.float32
) -> wp.float32:
    """∂F/∂v as mujoco_warp's implicit integrators take it: a stateless actuator's control is not clamped."""
    gain = wp.float32(0.0)
    if law.gaintype == GainType.AFFINE:
        gain = law.gainprm[2]
    elif law.gaintype == GainType.MUSCLE:
        gain = muscle_gain_vel_deriv(length, velocity, law.lengthrange, law.acc0, law.gainprm)
    bias = wp.float32(0.0)
    if law.biastype == BiasType.AFFINE:
        bias = law.biasprm[2]
    push = drive
    if law.dyntype == DynType.NONE:
        push = ctrl
    slope = gain * push + bias
    if law.clamp_force == 1:
        force = actuator_force(law, drive, length, velocity)
        if force <= law.forcerange[0] or force >= law.forcerange[1]:
            slope = wp.float32(0.0)
    return slope


@wp.func
def actuator_potential(
    law: ActuatorLaw,
    ctrl: wp.float32,
    act: wp.float32,
    length: wp.float32,
    velocity: wp.float32,
    act_weight: wp.float32,
    force_weight: wp.float32,
    slope_weight: wp.float32,
) -> wp.float32:
    """act_weight·act' + force_weight·F + slope_weight·∂F/∂v, whose slopes are the pullback of one actuator."""
    command = ctrl
    if law.clamp_ctrl == 1:
        command = wp.clamp(ctrl, law.ctrlrange[0], law.ctrlrange[1])
    drive = command
    potential = wp.float32(0.0)
    if law.dyntype != DynType.NONE:
        free = free_activation(law, command, act)
        after = free
        if law.clamp_act == 1:
            after = wp.clamp(free, law.actrange[0], law.actrange[1])
        drive = act
        if law.early == 1:
            drive = after
        if law.clamp_next == 1:
            potential = act_weight * after
        else:
            potential = act_weight * free
    if law.implicit == 1:
        potential += slope_weight * force_velocity_slope(law, ctrl, drive, length, velocity)
    return potential + force_weight * actuator_force(law, drive, length, velocity)


@wp.struct
class ActuatorSettings:
    """Parameters of actuators, and limits of the joints they act on."""

    jnt_type: wp.array[int]
    jnt_actfrclimited: wp.array[bool]
    jnt_actfrcrange: wp.array2d[wp.vec2]
    dof_jntid: wp.array[int]
    actuator_trntype: wp.array[int]
    actuator_trnid: wp.array[wp.vec2i]
    actuator_gear: wp.array2d[wp.spatial_vector]
    actuator_dyntype: wp.array[int]
    actuator_gaintype: wp.array[int]
    actuator_biastype: wp.array[int]
    actuator_ctrladr: wp.array[int]
    actuator_ctrlnum: wp.array[int]
    actuator_actadr: wp.array[int]
    actuator_actnum: wp.array[int]
    actuator_dynprm: wp.array2d[vec10]
    actuator_gainprm: wp.array2d[vec10]
    actuator_biasprm: wp.array2d[vec10]
    actuator_actlimited: wp.array[bool]
    actuator_actrange: wp.array2d[wp.vec2]
    actuator_actearly: wp.array[bool]
    actuator_forcelimited: wp.array[bool]
    actuator_forcerange: wp.array2d[wp.vec2]
    actuator_ctrllimited: wp.array[bool]
    actuator_ctrlrange: wp.array2d[wp.vec2]
    actuator_acc0: wp.array2d[float]
    actuator_lengthrange: wp.array2d[wp.vec2]


@wp.struct
class Drive:
    """Controls and activations, and how actuators pull: lengths (W, U), sparse moments, total on every dof."""

    ctrl: wp.array2d[float]
    act: wp.array2d[float]
    actuator_length: wp.array2d[float]
    moment_rownnz: wp.array2d[int]
    moment_rowadr: wp.array2d[int]
    moment_colind: wp.array2d[int]
    actuator_moment: wp.array2d[float]
    qfrc_actuator: wp.array2d[float]


@wp.func
def actuator_law(
    worldid: int, uid: int, timestep: float, clampctrl: bool, clampact: bool, actuators: ActuatorSettings
) -> ActuatorLaw:
    """The law of one actuator in one world."""
    law = ActuatorLaw()
    law.timestep = timestep
    law.dyntype = actuators.actuator_dyntype[uid]
    law.gaintype = actuators.actuator_gaintype[uid]
    law.biastype = actuators.actuator_biastype[uid]
    law.early = int(actuators.actuator_actearly[uid])
    law.clamp_act = int(actuators.actuator_actlimited[uid])
    law.clamp_next = int(clampact)
    law.clamp_force = int(actuators.actuator_forcelimited[uid])
    law.dynprm = actuators.actuator_dynprm[worldid % actuators.actuator_dynprm.shape[0], uid]
    law.gainprm = actuators.actuator_gainprm[worldid % actuators.actuator_gainprm.shape[0], uid]
    law.biasprm = actuators.actuator_biasprm[worldid % actuators.actuator_biasprm.shape[0], uid]
    law.actrange = actuators.actuator_actrange[worldid % actuators.actuator_actrange.shape[0], uid]
    law.forcerange = actuators.actuator_forcerange[worldid % actuators.actuator_forcerange.shape[0], uid]
    law.lengthrange = actuators.actuator_lengthrange[worldid % actuators.actuator_lengthrange.shape[0], uid]
    law.acc0 = actuators.actuator_acc0[worldid % actuators.actuator_acc0.shape[0], uid]
    source = actuators.actuator_ctrladr[uid]
    if actuators.actuator_ctrlnum[uid] > 0:
        law.ctrlrange = actuators.actuator_ctrlrange[worldid % actuators.actuator_ctrlrange.shape[0], source]
        law.clamp_ctrl = int(actuators.actuator_ctrllimited[source] and clampctrl)
    return law


@wp.func
def is_held(worldid: int, dof: int, actuators: ActuatorSettings, drive_in: Drive) -> bool:
    """Whether a dof's joint is at its actuator force limit and passes nothing on."""
    jnt = actuators.dof_jntid[dof]
    held = bool(False)
    if actuators.jnt_actfrclimited[jnt]:
        bounds = actuators.jnt_actfrcrange[worldid % actuators.jnt_actfrcrange.shape[0], jnt]
        total = drive_in.qfrc_actuator[worldid, dof]
        held = total <= bounds[0] or total >= bounds[1]
    return held


@wp.struct
class ActuatorBars:
    """What an actuator gives Φ, (W, U)."""

    length: wp.array2d[float]
    """∂Φ/∂len."""
    rate: wp.array2d[wp.vec4]
    """∂Φ/∂(ρ(λ), ρ(v), ρ(μ), ρ(â))."""
    implicit: wp.array2d[float]
    """h κ ∂F/∂v."""


@wp.struct
class ActuatorGradients:
    """Gradients by actuator, (W, U)."""

    actuator_gainprm: wp.array2d[vec10]
    actuator_biasprm: wp.array2d[vec10]
    actuator_dynprm: wp.array2d[vec10]


@wp.struct
class ActuatorRates:
    """Rates of an actuator's length under plain fields; λ does not move a joint at its force limit."""

    lam: float
    qvel: float
    mu: float
    smooth: float
    """Under â."""
    kappa: float
    """κ."""


@wp.func
def rates_of(
    worldid: int,
    start: int,
    end: int,
    implicit_all: bool,
    implicit_address: wp.array2d[int],
    actuators: ActuatorSettings,
    drive_in: Drive,
    state_in: State,
    multipliers_in: Multipliers,
) -> ActuatorRates:
    """Rates of the actuator whose moment is in the places from `start` to `end`.

    Those under μ and â, and κ, count entries that `implicit_address` has, with implicit integration alone.
    """
    out = ActuatorRates()
    for k in range(start, end):
        i = drive_in.moment_colind[worldid, k]
        lever = drive_in.actuator_moment[worldid, k]
        out.qvel += lever * state_in.qvel[worldid, i]
        if not is_held(worldid, i, actuators, drive_in):
            out.lam += lever * multipliers_in.lam[worldid, i]
        if implicit_all and implicit_address[i, i] >= 0:
            out.mu += lever * multipliers_in.mu[worldid, i]
            out.smooth += lever * (state_in.qacc[worldid, i] - multipliers_in.excess[worldid, i])
            for m in range(start, end):
                j = drive_in.moment_colind[worldid, m]
                if implicit_address[wp.max(i, j), wp.min(i, j)] >= 0:
                    smooth = state_in.qacc[worldid, j] - multipliers_in.excess[worldid, j]
                    pair = lever * drive_in.actuator_moment[worldid, m]
                    out.kappa += pair * multipliers_in.mu[worldid, i] * smooth
    return out


@wp.func
def is_straight(uid: int, actuators: ActuatorSettings) -> bool:
    """Whether the length is the integral of the moment, as for hinges and slides; `transmission` does the others."""
    kind = actuators.actuator_trntype[uid]
    straight = bool(False)
    if kind == TrnType.JOINT or kind == TrnType.JOINTINPARENT:
        joint = actuators.jnt_type[actuators.actuator_trnid[uid][0]]
        straight = joint == JointType.HINGE or joint == JointType.SLIDE
    return straight


@wp.func
def add_to_transmission(
    worldid: int,
    uid: int,
    start: int,
    end: int,
    length_bar: float,
    rate_bar: wp.vec4,
    implicit_all: bool,
    actuators: ActuatorSettings,
    drive_in: Drive,
    slopes_out: DofSlopes,
    tendon_bars_out: TendonBars,
) -> None:
    """Adds an actuator's cotangents to its tendon or its dofs; those of sites are left to `transmission`."""
    kind = actuators.actuator_trntype[uid]
    if kind == TrnType.SITE or kind == TrnType.SLIDERCRANK:
        return
    if kind == TrnType.TENDON:
        t = actuators.actuator_trnid[uid][0]
        gear = actuators.actuator_gear[worldid % actuators.actuator_gear.shape[0], uid][0]
        wp.atomic_add(tendon_bars_out.length, worldid, t, gear * length_bar)
        wp.atomic_add(tendon_bars_out.qvel, worldid, t, gear * rate_bar[1])
        wp.atomic_add(tendon_bars_out.lam, worldid, t, gear * rate_bar[0])
        if implicit_all:
            wp.atomic_add(tendon_bars_out.mu, worldid, t, gear * rate_bar[2])
            wp.atomic_add(tendon_bars_out.smooth, worldid, t, gear * rate_bar[3])
        return
    straight = is_straight(uid, actuators)
    for k in range(start, end):
        dof = drive_in.moment_colind[worldid, k]
        wp.atomic_add(slopes_out.qvel, worldid, dof, rate_bar[1] * drive_in.actuator_moment[worldid, k])
        if straight:
            wp.atomic_add(slopes_out.qpos, worldid, dof, length_bar * drive_in.actuator_moment[worldid, k])


@cache
def pull_actuators_kernel(keeps: bool) -> Any:
    """The kernel that also adds gradients of the law's own parameters, or the one that pays nothing for them."""

    @wp.kernel(module="unique", enable_backward=False)
    def pull_actuators(
        lanes: int,
        count: int,
        # Model:
        opt_timestep: wp.array[float],
        clampctrl: bool,
        clampact: bool,
        implicit_all: bool,
        implicit_address: wp.array2d[int],
        actuators: ActuatorSettings,
        # In:
        live_in: wp.array[int],
        drive_in: Drive,
        state_in: State,
        multipliers_in: Multipliers,
        # Out:
        grad_act_out: wp.array2d[float],
        grad_ctrl_out: wp.array2d[float],
        slopes_out: DofSlopes,
        tendon_bars_out: TendonBars,
        bars_out: ActuatorBars,
        gradients_out: ActuatorGradients,
        timestep_out: TimestepGradient,
    ) -> None:
        """Gradients of ctrl and act, and cotangents of length and rates; `lanes` threads take all `count` actuators."""
        worldid, lane = wp.tid()
        live = live_in[worldid] != 0
        h = opt_timestep[worldid % opt_timestep.shape[0]]
        for uid in range(lane, count, lanes):
            law = actuator_law(worldid, uid, h, clampctrl, clampact, actuators)
            law.implicit = int(implicit_all)
            ctrl = float(0.0)
            source = actuators.actuator_ctrladr[uid]
            if actuators.actuator_ctrlnum[uid] > 0:
                ctrl = drive_in.ctrl[worldid, source]
            act = float(0.0)
            act_weight = float(0.0)
            slot = actuators.actuator_actadr[uid] + actuators.actuator_actnum[uid] - 1
            if law.dyntype != DynType.NONE:
                act = drive_in.act[worldid, slot]
                act_weight = grad_act_out[worldid, slot]
            start = drive_in.moment_rowadr[worldid, uid]
            end = start + drive_in.moment_rownnz[worldid, uid]
            rates = rates_of(
                worldid, start, end, implicit_all, implicit_address, actuators, drive_in, state_in, multipliers_in
            )
            length = drive_in.actuator_length[worldid, uid]

            # The potential is -Φ and act': force and slope are its derivatives by the weights ρ(λ) and h κ.
            law_bar, ctrl_bar, act_bar, length_slope, velocity_slope, _act, force, slope = wp.grad(actuator_potential)(
                law, ctrl, act, length, rates.qvel, act_weight, rates.lam, h * rates.kappa
            )
            if law.dyntype != DynType.NONE:
                grad_act_out[worldid, slot] = wp.where(live, act_bar, 0.0)
            if live and actuators.actuator_ctrlnum[uid] > 0:
                grad_ctrl_out[worldid, source] += ctrl_bar
            # ∂Φ/∂ρ(λ) = -F ,  ∂Φ/∂ρ(μ) = -h F' ρ(â) ,  ∂Φ/∂ρ(â) = -h F' ρ(μ)
            rate_bar = wp.vec4(-force, -velocity_slope, -h * slope * rates.smooth, -h * slope * rates.mu)
            if not implicit_all:
                rate_bar[2] = 0.0
                rate_bar[3] = 0.0
            bars_out.length[worldid, uid] = -length_slope
            bars_out.rate[worldid, uid] = rate_bar
            bars_out.implicit[worldid, uid] = h * slope * rates.kappa
            if wp.static(keeps):
                if live and gradients_out.actuator_gainprm.shape[0] > 0:
                    gradients_out.actuator_gainprm[worldid, uid] += law_bar.gainprm
                    gradients_out.actuator_biasprm[worldid, uid] += law_bar.biasprm
                    gradients_out.actuator_dynprm[worldid, uid] += law_bar.dynprm
                if live and timestep_out.timestep.shape[0] > 0:
                    wp.atomic_add(timestep_out.timestep, worldid, law_bar.timestep)
            add_to_transmission(
                worldid,
                uid,
                start,
                end,
                -length_slope,
                rate_bar,
                implicit_all,
                actuators,
                drive_in,
                slopes_out,
                tendon_bars_out,
            )

    return pull_actuators


class ActuatorForces:
    """Launches of what actuators give ∂Φ, and of the gradients of controls and activations.

    Attributes:
        bars: what `transmission` and the gradient of gears take on.
    """

    def __init__(self, work: Workspace) -> None:
        self._work = work
        self.bars = allocate(ActuatorBars, work.nworld, work.model.nactuator)
        self._meet = not motors_apart(work.mjm)

    def launch(self, at: Substep) -> None:
        """Launch the pullback of all actuators."""
        kinds = (ActuatorGradients, TimestepGradient)
        kernel = pull_actuators_kernel(at.wants(*kinds))
        groups = (self.bars, *(at.gradient(kind) for kind in kinds))
        meet = self._meet or at.wants(TimestepGradient)
        self._work.launch_lanes(kernel, self._work.model.nactuator, at, *groups, meet=meet)
