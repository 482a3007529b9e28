"""The stages of a substep around the laws: recomputation, linear systems, integrators, and the residual."""
