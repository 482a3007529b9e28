"""How the distance, point and frame of a contact move with its two bodies, by pair of geometries.

| module | contents |
|---|---|
| `primitives` | the kernel for pairs with a collision function of their own, and the laws of a plane |
| `primitive_laws`, `capsule_box` | the other laws of such pairs; of a capsule and a box, one a pair of features |
| `convex` | the kernel for all other pairs (MuJoCo's convex collision, two boxes), and which law fits which patches |
| `convex_laws` | their two laws: patches that touch away from faces, and a point above a face |
| `patches` | the surface of a geom around a contact, to second order: FACE, EDGE or POINT |
| `solids` | convex geoms with their pose, size and flat faces |
| `height_fields` | triangles of a height field around a point, which `solids` takes as faces |
| `support_points` | which point of a geom stands above another one's face, and how it moves |
| `side_lines` | the line at which a face clips the side of a capsule |
| `contact_point`, `contact_order` | the structs of a contact; which contacts one thread takes |
"""
