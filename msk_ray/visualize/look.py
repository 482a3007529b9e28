"""How a scene is drawn: contact forces as arrows, muscles in the colour of their activation. Uses only MuJoCo."""

import mujoco
import numpy as np

RELAXED, ACTIVE = np.array([0.16, 0.35, 0.75]), np.array([0.90, 0.10, 0.08])
"""Colours of a muscle at activation 0 and 1."""
FORCE = (0.95, 0.15, 0.55, 1.0)
"""Colour of contact forces."""
_BODY_ALPHA = 0.4
_TENDON_WIDTH = 0.005
"""Smallest radius of a muscle's tendon, in units of the model's extent."""
_ARROW = 2.0
"""Size of an arrow for a force equal to the whole weight, in units of the model's extent. MuJoCo draws half of it."""


class Look:
    """Draws the state of one model; changes only the model's visual fields."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._muscles = muscle_tendons(model)
        weight = float(model.body_mass.sum()) * float(np.linalg.norm(model.opt.gravity))
        if weight > 0.0:
            # MuJoCo draws map.force / meanmass metres per newton.
            model.vis.map.force = _ARROW * model.stat.extent * model.stat.meanmass / weight
        if self._muscles:
            # Muscles run close to the bones, mostly inside their geoms.
            model.vis.map.alpha = _BODY_ALPHA
            width = _TENDON_WIDTH * float(model.stat.extent)
            for tendon in self._muscles:
                model.tendon_width[tendon] = max(float(model.tendon_width[tendon]), width)
        model.vis.rgba.contactforce = FORCE
        model.vis.scale.forcewidth = 0.1

    @property
    def has_muscles(self) -> bool:
        return bool(self._muscles)

    def switch_on(self, option: mujoco.MjvOption) -> None:
        """Draw contact forces, and tendons if there are any; bodies of models with muscles are transparent."""
        option.flags[mujoco.mjtVisFlag.mjVIS_TRANSPARENT] = self.has_muscles
        option.flags[mujoco.mjtVisFlag.mjVIS_CONTACTFORCE] = True
        option.flags[mujoco.mjtVisFlag.mjVIS_CONTACTPOINT] = True
        option.flags[mujoco.mjtVisFlag.mjVIS_TENDON] = True

    def colour(self, act: np.ndarray) -> None:
        """Colour every muscle's tendon by its activation; with several muscles on a tendon, by the most active one.

        Args:
            act: shape (na,).
        """
        for tendon, addresses in self._muscles.items():
            share = float(np.clip(act[addresses].max(), 0.0, 1.0))
            self._model.tendon_rgba[tendon, :3] = (1.0 - share) * RELAXED + share * ACTIVE
            self._model.tendon_rgba[tendon, 3] = 1.0


def muscle_tendons(model: mujoco.MjModel) -> dict[int, list[int]]:
    """Tendon → addresses in `act` of the stateful actuators that pull on it."""
    found: dict[int, list[int]] = {}
    for actuator in range(model.nu):
        # An actuator with several states has its activation last.
        address = int(model.actuator_actadr[actuator]) + int(model.actuator_actnum[actuator]) - 1
        pulls = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON
        if pulls and model.actuator_actadr[actuator] >= 0:
            found.setdefault(int(model.actuator_trnid[actuator, 0]), []).append(address)
    return found


def default_camera(model: mujoco.MjModel) -> mujoco.MjvCamera:
    """The model's first camera, or one that follows its first moving body."""
    camera = mujoco.MjvCamera()
    if model.ncam:
        camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        camera.fixedcamid = 0
        return camera
    mujoco.mjv_defaultFreeCamera(model, camera)
    if model.nbody > 1:
        camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        camera.trackbodyid = 1
    return camera
