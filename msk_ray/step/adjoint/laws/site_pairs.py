"""Actuators between two sites: at a site relative to a reference site, and slider-cranks.

Both depend on where a point p lies in the frame (o, R) of another site. Their rate m·x is linear in the twists of both
bodies under a field x, with coefficients that turn with the poses. So one function of poses and twists gives all
slopes: those by the twists are the loads on the bodies, those by the poses are what the moment's turning gives.

At a reference site mujoco_warp leaves out the dofs that carry both sites: twists are relative to the body that carries
them, the common one.
"""

import warp as wp
from mujoco_warp import TrnType

from msk_ray.step.adjoint.groups import FieldBars, Fields, Motion, Substep
from msk_ray.step.adjoint.laws.actuators import ActuatorBars
from msk_ray.step.adjoint.laws.joint_springs import log_rate_pullback
from msk_ray.step.adjoint.laws.transmission import push_load, weighted_twist
from msk_ray.step.adjoint.spatial import point_velocity, turning_torque, wrench
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import mul_quat, quat_sub
from msk_ray.step.forward.model_tree import common_bodies

wp.set_module_options({"enable_backward": False})


@wp.struct
class SitePairs:
    """Actuators between sites, and whose the sites are."""

    body_rootid: wp.array[int]
    site_bodyid: wp.array[int]
    site_quat: wp.array2d[wp.quat]
    actuator_trntype: wp.array[int]
    actuator_trnid: wp.array[wp.vec2i]
    actuator_gear: wp.array2d[wp.spatial_vector]
    actuator_cranklength: wp.array2d[float]


@wp.func
def pair_potential(
    crank: wp.int32,
    gear: wp.spatial_vectorf,
    rod: wp.float32,
    length_bar: wp.float32,
    point: wp.vec3,
    origin: wp.vec3,
    frame: wp.mat33,
    centre: wp.vec3,
    frame_centre: wp.vec3,
    twist: wp.spatial_vectorf,
    frame_twist: wp.spatial_vectorf,
    common_twist: wp.spatial_vectorf,
) -> wp.float32:
    """length_bar · length + m·x; the length without what the relative rotation of both sites gives it.

    Args:
        point: the site p. origin, frame: the reference site or slider (o, R).
        centre, frame_centre: what the twists of each side's body are about.
    """
    own = twist - common_twist
    other = frame_twist - common_twist
    slide = point_velocity(own, point - centre) - point_velocity(other, origin - frame_centre)
    away = point - origin
    if crank == 0:
        push = wp.spatial_top(gear)
        turn = wp.spatial_bottom(gear)
        potential = length_bar * wp.dot(wp.transpose(frame) @ away, push) + wp.dot(frame @ push, slide)
        return potential + wp.dot(frame @ turn, wp.spatial_top(own) - wp.spatial_top(other))
    # length = s - √det ,  s = a·d ,  det = s² + r² - d·d
    axis = wp.vec3(frame[0, 2], frame[1, 2], frame[2, 2])
    s = wp.dot(away, axis)
    det = s * s + rod * rod - wp.dot(away, away)
    length = s
    along = axis
    across = away
    if det > 0.0:
        root = wp.sqrt(det)
        length = s - root
        along = (1.0 - s / root) * axis + away / root
        across = (1.0 - s / root) * away
    rate = wp.dot(along, slide) + wp.dot(across, wp.cross(wp.spatial_top(other), axis))
    return gear[0] * (length_bar * length + rate)


@wp.kernel
def pull_site_pairs(
    lanes: int,
    count: int,
    # Model:
    pairs: SitePairs,
    common_body: wp.array[int],
    # In:
    site_xpos_in: wp.array2d[wp.vec3],
    site_xmat_in: wp.array2d[wp.mat33],
    xquat_in: wp.array2d[wp.quat],
    motion_in: Motion,
    actuator_bars_in: ActuatorBars,
    fields_in: Fields,
    # Out:
    bars_out: FieldBars,
) -> None:
    """What length and rates of an actuator between two sites give both bodies.

    `common_body` is the body whose motion an actuator does not feel, 0 for none; (nu,).
    `lanes` threads take all `count` actuators of a world in turn.
    """
    worldid, lane = wp.tid()
    for uid in range(lane, count, lanes):
        kind = pairs.actuator_trntype[uid]
        site = pairs.actuator_trnid[uid][0]
        other_site = pairs.actuator_trnid[uid][1]
        if kind != TrnType.SLIDERCRANK and (kind != TrnType.SITE or other_site < 0):
            continue
        body = pairs.site_bodyid[site]
        other = pairs.site_bodyid[other_site]
        common = common_body[uid]
        rates = actuator_bars_in.rate[worldid, uid]
        length_bar = actuator_bars_in.length[worldid, uid]
        gear = pairs.actuator_gear[worldid % pairs.actuator_gear.shape[0], uid]
        crank = int(kind == TrnType.SLIDERCRANK)
        own_field = weighted_twist(body, worldid, rates, fields_in, motion_in.cvel)
        other_field = weighted_twist(other, worldid, rates, fields_in, motion_in.cvel)
        common_field = weighted_twist(common, worldid, rates, fields_in, motion_in.cvel)
        centre = motion_in.subtree_com[worldid, pairs.body_rootid[body]]
        other_centre = motion_in.subtree_com[worldid, pairs.body_rootid[other]]
        point = site_xpos_in[worldid, site]
        origin = site_xpos_in[worldid, other_site]
        frame = site_xmat_in[worldid, other_site]
        rod = pairs.actuator_cranklength[worldid % pairs.actuator_cranklength.shape[0], uid]
        _k, _g, _r, _l, point_bar, origin_bar, frame_bar, _c, _o, load, other_load, common_load = wp.grad(
            pair_potential
        )(
            crank,
            gear,
            rod,
            length_bar,
            point,
            origin,
            frame,
            centre,
            other_centre,
            own_field,
            other_field,
            common_field,
        )
        torque = wp.vec3(0.0)
        turn = wp.spatial_bottom(gear)
        if crank == 0 and wp.length_sq(turn) > 0.0:
            # length ∋ gear·log(Rᵀ Q): with Q turning by w in the world, d log = Jr⁻¹ Qᵀ w
            own_rest = pairs.site_quat[worldid % pairs.site_quat.shape[0], site]
            other_rest = pairs.site_quat[worldid % pairs.site_quat.shape[0], other_site]
            phi = quat_sub(mul_quat(xquat_in[worldid, body], own_rest), mul_quat(xquat_in[worldid, other], other_rest))
            torque = site_xmat_in[worldid, site] @ (length_bar * log_rate_pullback(phi, turn))
        own_moved = wrench(point_bar, torque, point - centre)
        other_moved = wrench(origin_bar, turning_torque(frame, frame_bar) - torque, origin - other_centre)
        push_load(body, worldid, rates, load, own_field, own_moved, bars_out)
        push_load(other, worldid, rates, other_load, other_field, other_moved, bars_out)
        push_load(common, worldid, rates, common_load, common_field, wp.spatial_vector(), bars_out)


class SitePairForces:
    """Launches of what actuators between two sites give ∂Φ.

    Args:
        bars: what `pull_actuators` leaves.
    """

    def __init__(self, work: Workspace, bars: ActuatorBars) -> None:
        self._work, self._bars = work, bars
        self._common_body = wp.array(common_bodies(work.mjm), dtype=int)

    def launch(self, at: Substep) -> None:
        """Launch the pullback of these actuators."""
        count = self._work.model.nactuator
        self._work.launch_lanes(pull_site_pairs, count, at, self._bars, common_body=self._common_body)
