"""Actuators whose moment turns with q: at sites, and in the parent's frame of ball and free joints."""

import warp as wp
from mujoco_warp import JointType, TrnType

from msk_ray.physics.adjoint.joints import log_rate_pullback
from msk_ray.physics.adjoint.spatial import carried, point_velocity, wrench
from msk_ray.physics.mjw_private import quat_to_vel

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pull_turning_joints(
    # Model:
    jnt_type: wp.array[int],
    jnt_qposadr: wp.array[int],
    jnt_dofadr: wp.array[int],
    actuator_trntype: wp.array[int],
    actuator_trnid: wp.array[wp.vec2i],
    actuator_gear: wp.array2d[wp.spatial_vector],
    # In:
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    qacc_in: wp.array2d[float],
    lam_in: wp.array2d[float],
    mu_in: wp.array2d[float],
    excess_in: wp.array2d[float],
    moment_rowadr_in: wp.array2d[int],
    moment_in: wp.array2d[float],
    length_bar_in: wp.array2d[float],
    rate_bar_in: wp.array2d[wp.vec4],
    # Out:
    phi_qpos_out: wp.array2d[float],
) -> None:
    """len = gear·log(q) of a ball joint; in the parent's frame the moment is m = R(q)ᵀ gear."""
    worldid, uid = wp.tid()
    kind = actuator_trntype[uid]
    if kind != TrnType.JOINT and kind != TrnType.JOINTINPARENT:
        return
    jnt = actuator_trnid[uid][0]
    joint = jnt_type[jnt]
    if joint != JointType.BALL and joint != JointType.FREE:
        return
    dof = jnt_dofadr[jnt]
    first = moment_rowadr_in[worldid, uid]
    slope = wp.vec3(0.0)
    if joint == JointType.BALL:
        q = jnt_qposadr[jnt]
        quat = wp.quat(qpos_in[worldid, q], qpos_in[worldid, q + 1], qpos_in[worldid, q + 2], qpos_in[worldid, q + 3])
        phi = quat_to_vel(wp.normalize(quat))
        gear = wp.spatial_top(actuator_gear[worldid % actuator_gear.shape[0], uid])
        slope = length_bar_in[worldid, uid] * log_rate_pullback(phi, gear)
    else:
        dof += 3
        first += 3
    if kind == TrnType.JOINTINPARENT:
        bars = rate_bar_in[worldid, uid]
        moment = wp.vec3(moment_in[worldid, first], moment_in[worldid, first + 1], moment_in[worldid, first + 2])
        x = wp.vec3(0.0)
        for i in range(3):
            smooth = qacc_in[worldid, dof + i] - excess_in[worldid, dof + i]
            x[i] = bars[0] * lam_in[worldid, dof + i] + bars[1] * qvel_in[worldid, dof + i]
            x[i] += bars[2] * mu_in[worldid, dof + i] + bars[3] * smooth
        # m·x = gear·R x ,  d(R x) = R (w × x)
        slope += wp.cross(x, moment)
    for i in range(3):
        wp.atomic_add(phi_qpos_out, worldid, dof + i, slope[i])


@wp.kernel
def pull_sites(
    # Model:
    body_rootid: wp.array[int],
    site_bodyid: wp.array[int],
    actuator_trntype: wp.array[int],
    actuator_trnid: wp.array[wp.vec2i],
    actuator_gear: wp.array2d[wp.spatial_vector],
    # In:
    site_xpos_in: wp.array2d[wp.vec3],
    site_xmat_in: wp.array2d[wp.mat33],
    subtree_com_in: wp.array2d[wp.vec3],
    rate_bar_in: wp.array2d[wp.vec4],
    lam_field_in: wp.array2d[wp.spatial_vector],
    cvel_in: wp.array2d[wp.spatial_vector],
    qacc_field_in: wp.array2d[wp.spatial_vector],
    mu_field_in: wp.array2d[wp.spatial_vector],
    excess_field_in: wp.array2d[wp.spatial_vector],
    # Out:
    lam_bar_out: wp.array2d[wp.spatial_vector],
    qvel_bar_out: wp.array2d[wp.spatial_vector],
    qacc_bar_out: wp.array2d[wp.spatial_vector],
    mu_bar_out: wp.array2d[wp.spatial_vector],
    excess_bar_out: wp.array2d[wp.spatial_vector],
    moved_bar_out: wp.array2d[wp.spatial_vector],
) -> None:
    """m·x = F·u(x) + T·ω(x) at the site, with force F and torque T fixed in the site's frame; len = 0."""
    worldid, uid = wp.tid()
    if actuator_trntype[uid] != TrnType.SITE:
        return
    site = actuator_trnid[uid][0]
    body = site_bodyid[site]
    if body == 0:
        return
    gear = actuator_gear[worldid % actuator_gear.shape[0], uid]
    mat = site_xmat_in[worldid, site]
    force = mat @ wp.spatial_top(gear)
    torque = mat @ wp.spatial_bottom(gear)
    arm = site_xpos_in[worldid, site] - subtree_com_in[worldid, body_rootid[body]]
    load = wrench(force, torque, arm)
    bars = rate_bar_in[worldid, uid]
    smooth = qacc_field_in[worldid, body] - excess_field_in[worldid, body]
    total = bars[0] * lam_field_in[worldid, body] + bars[1] * cvel_in[worldid, body]
    total += bars[2] * mu_field_in[worldid, body] + bars[3] * smooth
    wp.atomic_add(lam_bar_out, worldid, body, bars[0] * load)
    wp.atomic_add(qvel_bar_out, worldid, body, bars[1] * load)
    wp.atomic_add(mu_bar_out, worldid, body, bars[2] * load)
    # â = a - (a - â)
    wp.atomic_add(qacc_bar_out, worldid, body, bars[3] * load)
    wp.atomic_add(excess_bar_out, worldid, body, -bars[3] * load)
    # The point moves (p̄ = F × ω), and F and T turn with the body: torques F × u and T × ω.
    spin = wp.spatial_top(total)
    turn = wp.cross(force, point_velocity(total, arm)) + wp.cross(torque, spin)
    wp.atomic_add(moved_bar_out, worldid, body, carried(total, load) + wrench(wp.cross(force, spin), turn, arm))
