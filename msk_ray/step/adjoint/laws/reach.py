"""Contact before touching: pairs of geoms that approach each other get a gradient too, in the backward pass only.

Where the contact of a pair is within reach r but does not touch, the backward pass adds to the pair's equation of
motion a normal force without a value but with a slope,

    ∂f/∂d = -κ (1 - d/r) ,  κ the stiffness of the pair's contact where it begins to touch,

so that the gradient of the distance d fades in from the reach to the touch. It is no derivative of the step, which is
unchanged. The idea is that of DiffMJX (arXiv:2506.14186), contacts from distance.
"""

import warp as wp

from msk_ray.step.adjoint.groups import ContactBars, Contacts, Fields, Motion, Shapes, Substep, gather
from msk_ray.step.adjoint.laws.rows import row_slopes
from msk_ray.step.adjoint.spatial import point_velocity
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import contact_kbimp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pull_reached(
    # Model:
    opt_timestep: wp.array[float],
    opt_disableflags: int,
    shapes: Shapes,
    body_invweight0: wp.array2d[wp.vec2],
    reach: float,
    substep: int,
    # In:
    nacon_in: wp.array[int],
    contacts_in: Contacts,
    motion_in: Motion,
    fields_in: Fields,
    # Out:
    contact_bars_out: ContactBars,
    last_out: wp.array[int],
    count_out: wp.array[int],
) -> None:
    """Φ ∋ -n·ρ(λ) f(d)  ⇒  cotangent of d: κ (1 - d/r) n·ρ(λ), for contacts without rows."""
    con = wp.tid()
    if con >= wp.min(nacon_in[0], contacts_in.dist.shape[0]):
        return
    gap = contacts_in.dist[con] - contacts_in.includemargin[con]
    if contacts_in.efc_address[con, 0] >= 0 or gap < 0.0 or gap >= reach:
        return
    worldid = contacts_in.worldid[con]
    geoms = contacts_in.geom[con]
    body1 = shapes.geom_bodyid[geoms[0]]
    body2 = shapes.geom_bodyid[geoms[1]]
    point = contacts_in.pos[con]
    arm1 = point - motion_in.subtree_com[worldid, shapes.body_rootid[body1]]
    arm2 = point - motion_in.subtree_com[worldid, shapes.body_rootid[body2]]
    slide = point_velocity(fields_in.lam[worldid, body2], arm2) - point_velocity(fields_in.lam[worldid, body1], arm1)
    rate = wp.dot(contacts_in.frame[con][0], slide)
    if rate == 0.0:
        return
    timestep = opt_timestep[worldid % opt_timestep.shape[0]]
    solref = contacts_in.solref[con]
    solimp = contacts_in.solimp[con]
    impedance = contact_kbimp(opt_disableflags, timestep, solref, solimp, 0.0, False)[2]
    spring = row_slopes(opt_disableflags, timestep, solref, solimp, 0.0).spring
    row = worldid % body_invweight0.shape[0]
    weight = body_invweight0[row, body1][0] + body_invweight0[row, body2][0]
    mass = impedance / ((1.0 - impedance) * wp.max(weight, 1.0e-15))
    contact_bars_out.dist[con] = spring * mass * (1.0 - gap / reach) * rate
    if wp.atomic_exch(last_out, worldid, substep) != substep:
        wp.atomic_add(count_out, 0, 1)


class ReachedContacts:
    """Launches for one reach [m], and a count of the world-substeps with a pair in it."""

    def __init__(self, work: Workspace, contacts: int, reach: float) -> None:
        self._work, self._contacts, self._reach = work, contacts, reach
        self._shapes = gather(Shapes, work.model)
        self._last = wp.zeros(work.nworld, dtype=int)
        self._count = wp.zeros(1, dtype=int)

    def start(self) -> None:
        """Launch the beginning of an env step's pullback."""
        self._last.zero_()

    def launch(self, at: Substep, bars: ContactBars) -> None:
        """Launch the cotangents of distances; those of touching contacts must be in `bars`."""
        work, m, d = self._work, self._work.model, at.data
        wp.launch(
            pull_reached,
            dim=self._contacts,
            inputs=[
                m.opt.timestep,
                m.opt.disableflags,
                self._shapes,
                m.body_invweight0,
                self._reach,
                work.touch_counter.substep,
                d.nacon,
                at.contacts,
                at.motion,
                work.fields,
            ],
            outputs=[bars, self._last, self._count],
        )

    def read(self) -> int:
        """World-substeps counted since the last read."""
        count = int(self._count.numpy()[0])
        self._count.zero_()
        return count
