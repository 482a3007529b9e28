"""The triangles of a height field around one point, as MuJoCo's collision splits its cells.

MuJoCo collides a geom with the prism below each triangle by itself. Faces are counted within the window of 3×3 cells
around the point: two for each cell, row by row.
"""

import warp as wp

from msk_ray.step.adjoint.groups import Meshes

wp.set_module_options({"enable_backward": False})

WINDOW_FACES = wp.constant(18)


@wp.func
def window_at(field: int, meshes: Meshes, point: wp.vec3) -> tuple[wp.int32, wp.int32]:
    """(row, column) of the first cell of the window around a point in the field's coordinates."""
    size = meshes.hfield_size[field]
    rows = meshes.hfield_nrow[field]
    columns = meshes.hfield_ncol[field]
    row = int(wp.floor((point[1] + size[1]) * 0.5 * float(rows - 1) / size[1]))
    column = int(wp.floor((point[0] + size[0]) * 0.5 * float(columns - 1) / size[0]))
    row = wp.clamp(row - 1, 0, wp.max(0, rows - 4))
    column = wp.clamp(column - 1, 0, wp.max(0, columns - 4))
    return row, column


@wp.func
def triangle_corner(field: int, first_row: int, first_column: int, meshes: Meshes, face: int, k: int) -> wp.vec3:
    """Corner k < 3 of a face of the window, in the field's coordinates; outside a small field cells repeat."""
    size = meshes.hfield_size[field]
    rows = meshes.hfield_nrow[field]
    columns = meshes.hfield_ncol[field]
    cell = face / 2
    row = wp.min(first_row + cell / 3, rows - 2)
    column = wp.min(first_column + cell % 3, columns - 2)
    # The diagonal runs from (row, column) to (row + 1, column + 1).
    if k == 1:
        row += 1
        column += 1
    elif k == 2:
        if face % 2 == 0:
            row += 1
        else:
            column += 1
    x = 2.0 * size[0] * float(column) / float(columns - 1) - size[0]
    y = 2.0 * size[1] * float(row) / float(rows - 1) - size[1]
    return wp.vec3(x, y, size[2] * meshes.hfield_data[meshes.hfield_adr[field] + row * columns + column])


@wp.func
def triangle_normal(field: int, first_row: int, first_column: int, meshes: Meshes, face: int) -> wp.vec3:
    """Upward normal of a face of the window."""
    first = triangle_corner(field, first_row, first_column, meshes, face, 0)
    along = triangle_corner(field, first_row, first_column, meshes, face, 1) - first
    normal = wp.normalize(wp.cross(along, triangle_corner(field, first_row, first_column, meshes, face, 2) - first))
    up = wp.vec3(0.0, 0.0, 1.0)
    return wp.sign(wp.dot(normal, up)) * normal
