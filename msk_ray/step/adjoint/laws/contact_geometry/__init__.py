"""How the distance, point and frame of a contact move with its two bodies, by pair of geometries."""
