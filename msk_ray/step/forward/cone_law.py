"""The law of an elliptic contact, which the fused solver, the adjoint and the gradients of materials share.

With N = μ jar₀ and uᵢ = φᵢ jarᵢ, T = |u|, the cone is circular. Its dual is satisfied where N ≥ μ T: no force. Where
μ N + T ≤ 0 all rows are springs, fᵢ = -Dᵢ jarᵢ: the contact sticks. Between, it slides and costs ½ m (N - μ T)²:

    f₀ = μ p ,  fᵢ = -f₀ φᵢ² jarᵢ / T ,  p = m (μ T - N) ,  m = D₀ / (μ² (1 + μ²)) .
"""

import warp as wp

from msk_ray.step.forward.mjw_private import ConstraintState

wp.set_module_options({"enable_backward": False})

SATISFIED = wp.constant(int(ConstraintState.SATISFIED))
QUADRATIC = wp.constant(int(ConstraintState.QUADRATIC))
SLIDING = wp.constant(int(ConstraintState.CONE))


@wp.func
def zone(normal: float, tangent: float, mu: float) -> int:
    """State of a contact with these N and T."""
    if normal >= mu * tangent:
        return SATISFIED
    if mu * normal + tangent <= 0.0:
        return QUADRATIC
    return SLIDING


@wp.func
def cone_mass(stiffness: float, mu: float) -> float:
    """m, from the D of the normal row."""
    return stiffness / (mu * mu * (1.0 + mu * mu))
