"""What the stages of a substep's pullback share: settings of the model, its tables, and the arrays they hand on."""

from dataclasses import dataclass
from typing import Any

import mujoco
import warp as wp

from msk_ray.step.adjoint.coverage.approximated import TouchCounter
from msk_ray.step.adjoint.groups import (
    DofSlopes,
    FieldBars,
    Fields,
    Joints,
    Multipliers,
    RowLaws,
    Springs,
    TendonBars,
    TendonRows,
    allocate,
    gather,
)
from msk_ray.step.adjoint.launches import Launcher
from msk_ray.step.adjoint.tables import build_tables
from msk_ray.step.forward.fused.scratch import padded
from msk_ray.step.forward.stages import Stages


@dataclass(frozen=True)
class Settings:
    """What a model's options switch on."""

    gravity_on: bool
    spring_on: bool
    damper_on: bool
    euler_damping: bool
    """Whether the integrator treats joint damping implicitly."""
    implicit_all: bool
    """Whether it treats all damping implicitly."""
    fluid_on: bool
    elliptic: bool
    actuation: bool
    clampctrl: bool
    clampact: bool
    """Whether a stage clamps activations after its own substep, which RK4 does only after all stages."""
    native_ccd: int
    """1 if boxes collide by convex collision too, 0 if by their own."""
    multi_ccd: int
    """1 if convex collision clips faces to find several contacts."""

    @property
    def implicit_damping(self) -> bool:
        """Whether it treats the damping of joints implicitly, alone or with all other."""
        return self.euler_damping or self.implicit_all

    @staticmethod
    def of(mjm: mujoco.MjModel) -> "Settings":
        """The settings of a model."""
        disabled, bit = mjm.opt.disableflags, mujoco.mjtDisableBit
        euler = mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        smooth = bit.mjDSBL_ACTUATION | bit.mjDSBL_SPRING | bit.mjDSBL_DAMPER
        # With all of these off, mujoco_warp's implicitfast is explicit.
        implicit = mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST and disabled & smooth != smooth
        return Settings(
            gravity_on=not disabled & bit.mjDSBL_GRAVITY,
            spring_on=not disabled & bit.mjDSBL_SPRING,
            damper_on=not disabled & bit.mjDSBL_DAMPER,
            euler_damping=bool(euler and not disabled & (bit.mjDSBL_EULERDAMP | bit.mjDSBL_DAMPER)),
            implicit_all=bool(implicit),
            fluid_on=bool(mjm.opt.density > 0 or mjm.opt.viscosity > 0),
            elliptic=bool(mjm.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC),
            actuation=bool(mjm.nu > 0 and not disabled & bit.mjDSBL_ACTUATION),
            clampctrl=not disabled & bit.mjDSBL_CLAMPCTRL,
            clampact=mjm.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4,
            native_ccd=int(not disabled & bit.mjDSBL_NATIVECCD),
            multi_ccd=int(not disabled & bit.mjDSBL_MULTICCD),
        )


class Workspace:
    """Allocates for `nworld` worlds of one model, on the device of `data`.

    Attributes:
        jacobian_width: length of a row of the full constraint Jacobian, a multiple of four, nv or more.
        live: worlds whose gradient is wanted, shape (W,), int.
        grad_qpos, grad_qvel, grad_act, grad_ctrl: cotangents, in tangent coordinates.
        multipliers, slopes, fields, bars, tendon_bars, laws: as their groups say.
        rhs: h v̄', shape (W, nv).
        damping: each dof's damping coefficients (c₀, c₁, c₂), shape (W, nv), vec3.
        contact_wrenches: slopes of Φ along displacements of both geoms of a contact, as wrenches about their centres,
            (C, 2); of no size unless they are wanted.
        stages: launches of the stages of a step.
        launch: launches a kernel whose arguments are found by their names.
        in_turn: whether one thread takes all contacts of a world, so that their sums have a fixed order.
        touches: where contacts without a derivative of their own are counted.
    """

    def __init__(self, mjm: mujoco.MjModel, model: Any, data: Any, stages: Stages) -> None:
        self.mjm = mjm
        self.launch = Launcher(self)
        self.in_turn = stages.ordered
        self.stages = stages
        self.model = model
        self.device = data.qpos.device
        self.nworld = data.nworld
        self.njmax = data.efc.D.shape[1]
        self.jacobian_width = padded(mjm.nv) if model.is_sparse else data.efc.J.shape[2]
        self.settings = Settings.of(mjm)
        worlds, nv, nbody = data.nworld, mjm.nv, mjm.nbody
        with wp.ScopedDevice(self.device):
            self.tables = build_tables(mjm, model)
            self.joints, self.tendon_rows = gather(Joints, model), gather(TendonRows, model)
            self.springs = gather(Springs, self.tables, model)
            self.touch_counter = TouchCounter(mjm, worlds)
            self.touches = self.touch_counter.touches
            self.live = wp.ones(worlds, dtype=int)
            self.grad_qpos, self.grad_qvel = (wp.zeros((worlds, nv), dtype=float) for _ in range(2))
            self.grad_act, self.grad_ctrl = (wp.zeros((worlds, n), dtype=float) for n in (mjm.na, mjm.nu))
            self.multipliers = allocate(Multipliers, worlds, nv)
            self.slopes = allocate(DofSlopes, worlds, nv)
            self.rhs, self.damping = wp.zeros((worlds, nv), dtype=float), wp.zeros((worlds, nv), dtype=wp.vec3)
            self.fields = allocate(Fields, worlds, nbody)
            self.bars = allocate(FieldBars, worlds, nbody)
            self.tendon_bars = allocate(TendonBars, worlds, max(mjm.ntendon, 1))
            self.laws = allocate(RowLaws, worlds, self.njmax)
            self.contact_wrenches = wp.zeros((0, 2), dtype=wp.spatial_vector)

    @property
    def substep(self) -> int:
        """Which substep is pulled back, from 1 for the last of an env step."""
        return self.touch_counter.substep

    def launch_lanes(self, kernel: Any, count: int, at: Any, *groups: Any, meet: bool = True, **named: Any) -> None:
        """Launch a kernel whose `lanes` threads a world take `count` elements in turn, as many as `lanes` says."""
        lanes = self.lanes(count, meet)
        self.launch(kernel, (self.nworld, lanes), at, *groups, lanes=lanes, count=count, **named)

    def lanes(self, count: int, meet: bool = True) -> int:
        """Threads that share `count` elements of a world: one each on a GPU; one on a CPU, and for a fixed order.

        A CPU runs threads one after the other, and passing each its arguments takes longer than a small element.
        Elements of one thread are added up in their order.

        Args:
            count: number of elements.
            meet: whether several of them may add to one number.
        """
        in_turn = meet and self.stages.ordered
        return max(count, 1) if self.device.is_cuda and not in_turn else 1
