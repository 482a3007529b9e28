"""How a scene is drawn: contact forces as arrows, muscles in the colour of their activation. Uses only MuJoCo."""

from collections.abc import Sequence

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


_REFERENCE = (0.82, 0.85, 0.92, 1.0)
"""Colour of a reference. MuJoCo would blend a transparent one with black where there is no background."""
_REFERENCE_SHIFT = np.array([0.0, 0.8, 0.0])
"""From where a reference is to where it is drawn, so that it can be told from the body that follows it [m]."""
DRAWN_GROUPS = (0, 1, 2)
"""Groups of geoms that MuJoCo draws by default."""
_HEADLIGHT = {"ambient": 0.35, "diffuse": 0.55, "specular": 0.2}
"""Light from the camera for models without lights, which would be rather dark."""
_SKY_TOP, _SKY_BOTTOM = np.array([237.0, 242.0, 250.0]), np.array([158.0, 178.0, 204.0])
"""Background of models without a sky, whose colours are those of `envs.options.add_sky`."""


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
        # Shadows of a directional light end a few metres from its position, which nothing else depends on.
        suns = (model.light_bodyid == 0) & (model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
        model.light_mode[suns] = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
        if model.nlight == 0:
            for part, strength in _HEADLIGHT.items():
                setattr(model.vis.headlight, part, [strength] * 3)

    @property
    def has_muscles(self) -> bool:
        return bool(self._muscles)

    def switch_on(self, option: mujoco.MjvOption, groups: Sequence[int]) -> None:
        """Draw contact forces, tendons, and the geoms of these groups; if there are muscles, bodies are transparent."""
        option.geomgroup = [number in groups for number in range(mujoco.mjNGROUP)]
        option.flags[mujoco.mjtVisFlag.mjVIS_TRANSPARENT] = self.has_muscles
        option.flags[mujoco.mjtVisFlag.mjVIS_CONTACTFORCE] = True
        option.flags[mujoco.mjtVisFlag.mjVIS_CONTACTPOINT] = True
        option.flags[mujoco.mjtVisFlag.mjVIS_TENDON] = True

    def add_reference(self, scene: mujoco.MjvScene, data: mujoco.MjData, option: mujoco.MjvOption) -> None:
        """Add the moving bodies once more to a scene, pale and to the side, as they are in `data`."""
        first = scene.ngeom
        bodies = mujoco.MjvOption()
        bodies.geomgroup = option.geomgroup
        moving = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
        mujoco.mjv_addGeoms(self._model, data, bodies, mujoco.MjvPerturb(), moving, scene)
        for geom in scene.geoms[first : scene.ngeom]:
            geom.pos += _REFERENCE_SHIFT
            geom.rgba[:] = _REFERENCE

    def colour(self, act: np.ndarray) -> None:
        """Colour every muscle's tendon by its activation; with several muscles on a tendon, by the most active one.

        Args:
            act: shape (na,).
        """
        for tendon, addresses in self._muscles.items():
            share = float(np.clip(act[addresses].max(), 0.0, 1.0))
            self._model.tendon_rgba[tendon, :3] = (1.0 - share) * RELAXED + share * ACTIVE
            self._model.tendon_rgba[tendon, 3] = 1.0


def geom_groups(model: mujoco.MjModel) -> tuple[int, ...]:
    """The groups of geoms to draw: those that MuJoCo draws, and if no moving body has a geom in these, also the groups
    of the moving bodies."""
    moving = model.geom_group[model.body_weldid[model.geom_bodyid] > 0].clip(0, mujoco.mjNGROUP - 1)
    if moving.size == 0 or np.isin(moving, DRAWN_GROUPS).any():
        return DRAWN_GROUPS
    return (*DRAWN_GROUPS, *sorted({int(group) for group in moving}))


def describe_groups(groups: Sequence[int]) -> str:
    """Which groups are drawn that MuJoCo would not draw, and why, in words; empty if there are none."""
    further = [str(group) for group in groups if group not in DRAWN_GROUPS]
    if not further:
        return ""
    return (
        f"geom group{'s' if len(further) > 1 else ''} {', '.join(further)} drawn too: no moving body has a geom in "
        "groups 0 to 2, which MuJoCo draws by default"
    )


def has_sky(model: mujoco.MjModel) -> bool:
    """Whether a model has a background of its own."""
    return bool(np.any(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX))


def add_background(frame: np.ndarray, depth: np.ndarray, far: float) -> np.ndarray:
    """A frame (height, width, 3), uint8, with a sky where nothing was drawn.

    Args:
        depth: distances (height, width) from the camera [m].
        far: the distance of what was not drawn [m].
    """
    height = len(frame)
    share = np.linspace(0.0, 1.0, height)[:, None]
    sky = ((1.0 - share) * _SKY_TOP + share * _SKY_BOTTOM).astype(np.uint8)
    return np.where((depth >= 0.999 * far)[..., None], sky[:, None, :], frame)


def muscle_tendons(model: mujoco.MjModel) -> dict[int, list[int]]:
    """Tendon → addresses in `act` of the stateful actuators that pull on it."""
    addresses: dict[int, list[int]] = {}
    for actuator in range(model.nu):
        # An actuator with several states has its activation last.
        address = int(model.actuator_actadr[actuator]) + int(model.actuator_actnum[actuator]) - 1
        pulls = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON
        if pulls and model.actuator_actadr[actuator] >= 0:
            addresses.setdefault(int(model.actuator_trnid[actuator, 0]), []).append(address)
    return addresses


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
