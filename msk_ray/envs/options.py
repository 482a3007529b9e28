"""Solver and integrator settings that every model takes from its physics section."""

import mujoco

from msk_ray.config import PhysicsConfig

INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
}
"""Integrators by the names that `physics.integrator` takes."""
_CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}
FUSED_SOLVER = {"mujoco_warp": False, "fused": True, "auto": None}
JACOBIANS = {"dense": mujoco.mjtJacobian.mjJAC_DENSE, "sparse": mujoco.mjtJacobian.mjJAC_SPARSE}


def add_sky(spec: mujoco.MjSpec) -> None:
    """A light background for pictures, without effect on the physics."""
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.95, 0.98],
        rgb2=[0.62, 0.70, 0.80],
        width=64,
        height=384,
    )


def add_grid(spec: mujoco.MjSpec) -> str:
    """A chequered material for the ground. Returns its name."""
    spec.add_texture(
        name="grid",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.25, 0.3, 0.35],
        rgb2=[0.32, 0.38, 0.44],
        width=256,
        height=256,
    )
    material = spec.add_material(name="grid", texrepeat=[1, 1], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    return "grid"


def apply_options(spec: mujoco.MjSpec, physics: PhysicsConfig, control_timestep: float) -> None:
    """Set timestep, solver and cone of `spec`: Newton, dense Jacobians and Euler, then what `physics` says."""
    option = spec.option
    option.timestep = control_timestep / physics.resolve_substeps(control_timestep)
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.integrator = INTEGRATORS["Euler"]
    override_options(spec, physics)


def override_options(spec: mujoco.MjSpec, physics: PhysicsConfig) -> None:
    """Set the solver and integrator settings of `physics`; those that are null stay as they are."""
    option = spec.option
    if physics.integrator is not None:
        option.integrator = INTEGRATORS[physics.integrator]
    if physics.cone is not None:
        option.cone = _CONES[physics.cone]
    if physics.iterations is not None:
        option.iterations = physics.iterations
    if physics.ls_iterations is not None:
        option.ls_iterations = physics.ls_iterations
    if physics.tolerance is not None:
        option.tolerance = physics.tolerance
