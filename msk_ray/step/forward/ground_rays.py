"""Rays straight down onto the ground: the geoms that are fixed to the world and can be touched.

Axes: W worlds, R rays, G geoms of the ground.
"""

import mujoco
import numpy as np
import warp as wp
from numpy.typing import NDArray

from msk_ray.step.errors import UnsupportedModelError
from msk_ray.step.forward.batch import WorldBatch
from msk_ray.step.forward.mjw_private import MJ_MAXVAL, ray_geom, ray_hfield, ray_mesh

_HFIELD, _MESH = wp.constant(int(mujoco.mjtGeom.mjGEOM_HFIELD)), wp.constant(int(mujoco.mjtGeom.mjGEOM_MESH))
_MARGIN = 1e-5
"""Margin of the geoms' rectangles, a share of their coordinates plus 1 m: a hundred times float32's rounding."""


def ground_geoms(model: mujoco.MjModel) -> list[int]:
    """Ids of the geoms of the ground.

    Raises:
        UnsupportedModelError: there are none.
    """
    paired = {*map(int, model.pair_geom1), *map(int, model.pair_geom2)}
    found = [
        g
        for g in range(model.ngeom)
        if model.body_weldid[model.geom_bodyid[g]] == 0
        and (model.geom_contype[g] or model.geom_conaffinity[g] or g in paired)
    ]
    if not found:
        raise UnsupportedModelError("the model has no ground: no geom is fixed to the world and can be touched")
    return found


@wp.kernel(enable_backward=False)
def cast_down(
    # Model:
    nmeshface: int,
    geom_type: wp.array[int],
    geom_dataid: wp.array2d[int],
    geom_size: wp.array2d[wp.vec3],
    mesh_vertadr: wp.array[int],
    mesh_faceadr: wp.array[int],
    mesh_vert: wp.array[wp.vec3],
    mesh_face: wp.array[wp.vec3i],
    hfield_size: wp.array[wp.vec4],
    hfield_nrow: wp.array[int],
    hfield_ncol: wp.array[int],
    hfield_adr: wp.array[int],
    hfield_data: wp.array[float],
    # In:
    tree: wp.uint64,
    ground_in: wp.array[int],
    position_in: wp.array[wp.vec3],
    rotation_in: wp.array[wp.mat33],
    origin_in: wp.array2d[wp.vec3],
    # Out:
    distance_out: wp.array2d[float],
    normal_out: wp.array2d[wp.vec3],
) -> None:
    """The nearest hit of each vertical ray among the geoms whose rectangles contain it; of equally near ones, the hit
    of the geom that comes first, in whatever order the tree gives them."""
    world, ray = wp.tid()
    start = origin_in[world, ray]
    down = wp.vec3(0.0, 0.0, -1.0)
    place = wp.vec3(start[0], start[1], 0.0)
    nearest = float(MJ_MAXVAL)
    first = int(-1)
    normal_there = wp.vec3()
    query = wp.bvh_query_aabb(tree, place, place)
    k = int(0)
    while wp.bvh_query_next(query, k):
        geom, pos, mat = ground_in[k], position_in[k], rotation_in[k]
        size = geom_size[world % geom_size.shape[0], geom]
        kind = geom_type[geom]
        if kind == _HFIELD:
            distance, normal = ray_hfield(
                geom_dataid,
                hfield_size,
                hfield_nrow,
                hfield_ncol,
                hfield_adr,
                hfield_data,
                pos,
                mat,
                start,
                down,
                geom,
                world,
            )
        elif kind == _MESH:
            mesh = geom_dataid[world % geom_dataid.shape[0], geom]
            distance, normal = ray_mesh(
                nmeshface, mesh_vertadr, mesh_faceadr, mesh_vert, mesh_face, mesh, pos, mat, size, start, down
            )
        else:
            distance, normal = ray_geom(pos, mat, size, start, down, kind)
        if distance >= 0.0 and (distance < nearest or (distance == nearest and k < first)):
            nearest, first, normal_there = distance, k, normal
    distance_out[world, ray] = wp.where(first < 0, -1.0, nearest)
    normal_out[world, ray] = normal_there


class GroundRays:
    """Casts rays onto the ground by the functions of `mujoco_warp.rays`, each only onto the geoms above or below it.

    The ground lies where the model has it, in all worlds; its geoms' sizes are those of each world.

    Args:
        batch: the worlds.

    Raises:
        UnsupportedModelError: the model has no ground.
    """

    def __init__(self, batch: WorldBatch) -> None:
        self._model, self._device = batch.model, batch.device
        mjm, ground = batch.mjm, np.array(ground_geoms(batch.mjm), dtype=np.int32)
        data = mujoco.MjData(mjm)
        mujoco.mj_kinematics(mjm, data)  # geoms that are fixed to the world have the same place in every state
        position, rotation = data.geom_xpos[ground], data.geom_xmat[ground].reshape(-1, 3, 3)
        everywhere = mjm.geom_type[ground] == mujoco.mjtGeom.mjGEOM_PLANE
        if "geom_size" in batch.parameters:  # a step can make them larger
            everywhere[:] = True
        low, high = _rectangles(position, rotation, mjm.geom_aabb[ground], everywhere)
        with wp.ScopedDevice(self._device):
            self._ground = wp.array(ground, dtype=int)
            self._position, self._rotation = wp.array(position, dtype=wp.vec3), wp.array(rotation, dtype=wp.mat33)
            self._tree = wp.Bvh(wp.array(low, dtype=wp.vec3), wp.array(high, dtype=wp.vec3), constructor="sah")

    def launch(self, origin: wp.array, distance: wp.array, normal: wp.array) -> None:
        """Launch the rays.

        Args:
            origin: where they begin [m], vec3, (W, R).
            distance: how far below that they meet the ground [m], (W, R); -1 if they do not. Written.
            normal: the ground's normal there, vec3, (W, R); 0 if they do not. Written.
        """
        m = self._model
        wp.launch(
            cast_down,
            dim=origin.shape,
            inputs=[
                *(m.nmeshface, m.geom_type, m.geom_dataid, m.geom_size),
                *(m.mesh_vertadr, m.mesh_faceadr, m.mesh_vert, m.mesh_face),
                *(m.hfield_size, m.hfield_nrow, m.hfield_ncol, m.hfield_adr, m.hfield_data),
                *(self._tree.id, self._ground, self._position, self._rotation, origin),
            ],
            outputs=[distance, normal],
            device=self._device,
        )


def _rectangles(
    position: NDArray[np.float64],
    rotation: NDArray[np.float64],
    box: NDArray[np.float64],
    everywhere: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corners of the geoms seen from above, each (G, 3) [m], at z = 0.

    Args:
        position, rotation: frames of the geoms, (G, 3) and (G, 3, 3).
        box: centres and half sides of their bounding boxes, in these frames, (G, 6).
        everywhere: whether a geom has no bounds, (G,).
    """
    centre = position + np.einsum("gij,gj->gi", rotation, box[:, :3])
    half = np.einsum("gij,gj->gi", np.abs(rotation), box[:, 3:])
    half += _MARGIN * (1.0 + np.abs(centre) + half)
    centre[everywhere], half[everywhere] = 0.0, MJ_MAXVAL
    centre[:, 2] = half[:, 2] = 0.0
    return centre - half, centre + half
