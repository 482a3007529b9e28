"""Segments, joints and muscles of `myoleg26`: the numbers and where they come from.

Sources:
    gait14dof22  "A reduced 3D gait model with 14 degrees of freedom and 22 muscles", gait14dof22musc_20170320.osim of
                 osim-rl (MIT licence): Delp et al. 1990 (IEEE Trans Biomed Eng 37:757), Anderson & Pandy 1999,
                 Yamaguchi & Zajac 1989; strengths after Handsfield et al. 2014 and Rajagopal et al. 2016.
    gait2392     gait2392_thelen2003muscle.osim of opensim-models (Delp et al. 1990; Thelen 2003).

Frames are those of the sources: x forward, y up, z to the right, of the right leg; the builder mirrors it. Lengths [m],
masses [kg], inertias [kg m²] about the centre of mass, forces [N], angles [rad].

Not from the sources: `OUTLINE` (contact primitives laid along the sole and trunk), joint ranges (those of daily
activity rather than the ±120° of the sources, so that fibres can stay inside their range), the cylinder that replaces
the moving and conditional path points of the knee extensors, the origin of gastrocnemius, 9 mm further up in place of
its conditional point, and the hamstrings' conditional point, which is always on their path.
"""

from typing import Final, NamedTuple

Vec3 = tuple[float, float, float]


class Segment(NamedTuple):
    """A rigid body."""

    name: str
    parent: str
    origin: Vec3
    """Position in the parent's frame."""
    mass: float
    centre: Vec3
    """Centre of mass."""
    inertia: Vec3
    """Principal moments, about x, y, z."""


class Hinge(NamedTuple):
    """A joint of the segment it is listed under."""

    name: str
    segment: str
    axis: Vec3
    lower: float
    upper: float


class Muscle(NamedTuple):
    """A muscle and its path."""

    name: str
    force: float
    """Largest isometric force F of the source."""
    fibre: float
    """Optimal fibre length of the source."""
    pennation: float
    """Pennation at optimal fibre length; its cosine scales F, since the model's fibres run along the path."""
    speed: float
    """Largest shortening speed [optimal fibre lengths of the source per second]."""
    path: tuple[tuple[str, Vec3], ...]
    """Points by segment; a segment written `wrap:NAME` is the cylinder NAME, its point the side the path keeps to."""


PELVIS: Final = Segment("pelvis", "world", (0.0, 0.0, 0.0), 11.777, (-0.0707, 0.0, 0.0), (0.1028, 0.0871, 0.0579))
TORSO: Final = Segment("torso", "pelvis", (-0.1007, 0.0815, 0.0), 34.2366, (-0.03, 0.32, 0.0), (1.4745, 0.7555, 1.4314))
"""Trunk, head and arms as one segment, fixed to the pelvis."""

# gait14dof22. The subtalar joint is locked, so its talus is part of the foot: 0.1 kg at the ankle, which `talus` keeps.
LEG: Final = (
    Segment("femur", "pelvis", (-0.0707, -0.0661, 0.0835), 9.3014, (0.0, -0.17, 0.0), (0.1339, 0.0351, 0.1412)),
    Segment("tibia", "femur", (-0.0036, -0.395, 0.0), 3.7075, (0.0, -0.1867, 0.0), (0.0504, 0.0051, 0.0511)),
    Segment("talus", "tibia", (0.0, -0.43, 0.0), 0.1, (0.0, 0.0, 0.0), (0.001, 0.001, 0.001)),
    Segment("calcn", "talus", (-0.04877, -0.04195, 0.00792), 1.25, (0.1, 0.03, 0.0), (0.0014, 0.0039, 0.0041)),
    Segment("toes", "calcn", (0.1788, -0.002, 0.00108), 0.2166, (0.0346, 0.006, -0.0175), (0.0001, 0.0002, 0.0001)),
)

ROOT: Final = (
    ("pelvis_tx", "slide", (1.0, 0.0, 0.0)),
    ("pelvis_ty", "slide", (0.0, 1.0, 0.0)),
    ("pelvis_tz", "slide", (0.0, 0.0, 1.0)),
    ("pelvis_tilt", "hinge", (0.0, 0.0, 1.0)),
    ("pelvis_list", "hinge", (1.0, 0.0, 0.0)),
    ("pelvis_rotation", "hinge", (0.0, 1.0, 0.0)),
)
"""Pelvis in the world, in the source's order: forward, up and right; tilt backward, list to the right, turn left."""

# Positive is flexion, adduction and inward rotation of the hip, extension of the knee, dorsiflexion of the ankle and
# extension of the toes.
JOINTS: Final = (
    Hinge("hip_flexion", "femur", (0.0, 0.0, 1.0), -0.5236, 1.5708),
    Hinge("hip_adduction", "femur", (1.0, 0.0, 0.0), -0.6981, 0.3491),
    Hinge("hip_rotation", "femur", (0.0, 1.0, 0.0), -0.5236, 0.5236),
    Hinge("knee_angle", "tibia", (0.0, 0.0, 1.0), -1.9897, 0.0),
    Hinge("ankle_angle", "talus", (0.0, 0.0, 1.0), -0.8727, 0.4363),
    Hinge("mtp_angle", "toes", (0.0, 0.0, 1.0), -0.5236, 0.7854),
)

CYLINDERS: Final = {"patella": ("femur", (-0.0036, -0.395, 0.0), 0.038, 0.05)}
"""By name: segment, centre, radius and half length of a cylinder along the knee's axis; its radius is a moment arm."""

MUSCLES: Final = (
    Muscle(
        "abd", 4460.29, 0.0845, 0.0, 15.0,
        (("pelvis", (-0.0855, 0.0445, 0.0766)), ("femur", (-0.0258, -0.0058, 0.0527))),
    ),
    Muscle(
        "add", 3931.8, 0.087, 0.08726646, 15.0,
        (("pelvis", (-0.0732, -0.1174, 0.0255)), ("femur", (-0.0045, -0.1211, 0.0339))),
    ),
    Muscle(
        "hamstrings", 4105.465574, 0.069, 0.26179939, 15.0,
        (
            ("pelvis", (-0.1192, -0.09747, 0.07151)),
            ("tibia", (-0.0348, -0.03519, -0.01891)),
            ("tibia", (-0.027, -0.04771, -0.01957)),
        ),
    ),
    Muscle(
        "bifemsh", 557.11475409836, 0.11, 0.40142573, 15.0,
        (
            ("femur", (0.005, -0.2111, 0.0234)),
            ("tibia", (-0.0301, -0.036, 0.02943)),
            ("tibia", (-0.0234, -0.0563, 0.0343)),
        ),
    ),
    Muscle(
        "glutmax", 3337.583607, 0.157, 0.0, 15.0,
        (
            ("pelvis", (-0.1349, 0.0176, 0.0563)),
            ("pelvis", (-0.1376, -0.052, 0.0914)),
            ("femur", (-0.0426, -0.053, 0.0293)),
            ("femur", (-0.0156, -0.1016, 0.0419)),
        ),
    ),
    Muscle(
        "iliopsoas", 2697.344262, 0.117, 0.13962634, 15.0,
        (
            ("pelvis", (-0.0647, 0.0887, 0.0289)),
            ("pelvis", (-0.0238, -0.057, 0.0759)),
            ("femur", (0.0016, -0.0507, 0.0038)),
            ("femur", (-0.0188, -0.0597, 0.0104)),
        ),
    ),
    Muscle(
        "rectfem", 2191.74098360656, 0.076, 0.08726646, 15.0,
        (
            ("pelvis", (-0.0295, -0.0311, 0.0968)),
            ("wrap:patella", (0.09, -0.395, 0.0)),
            ("tibia", (0.045, -0.06, 0.0014)),
        ),
    ),
    Muscle(
        "vasti", 9593.95082, 0.099, 0.05235988, 15.0,
        (
            ("femur", (0.029, -0.1924, 0.031)),
            ("femur", (0.0335, -0.2084, 0.0285)),
            ("wrap:patella", (0.09, -0.395, 0.0)),
            ("tibia", (0.045, -0.06, 0.0018)),
        ),
    ),
    Muscle(
        "gastroc", 4690.57377, 0.051, 0.29670597, 15.0,
        (
            ("femur", (-0.0206, -0.3845, -0.0235)),
            ("calcn", (0.0, 0.031, -0.0053)),
        ),
    ),
    Muscle(
        "soleus", 7924.996721, 0.044, 0.43633231, 15.0,
        (("tibia", (-0.0024, -0.1533, 0.0071)), ("calcn", (0.0, 0.031, -0.0053))),
    ),
    Muscle(
        "tibant", 2116.818162, 0.068, 0.08726646, 15.0,
        (
            ("tibia", (0.0179, -0.1624, 0.0115)),
            ("tibia", (0.0329, -0.3951, -0.0177)),
            ("calcn", (0.1166, 0.0178, -0.0305)),
        ),
    ),
    Muscle(  # gait2392
        "edl", 512.0, 0.102, 0.13962634, 10.0,
        (
            ("tibia", (0.0032, -0.1381, 0.0276)),
            ("tibia", (0.0289, -0.4007, 0.0072)),
            ("calcn", (0.0922, 0.0388, -0.0001)),
            ("calcn", (0.1616, 0.0055, 0.013)),
            ("toes", (0.0003, 0.0047, 0.0153)),
            ("toes", (0.0443, -0.0004, 0.025)),
        ),
    ),
    Muscle(  # gait2392
        "fdl", 310.0, 0.034, 0.12217305, 10.0,
        (
            ("tibia", (-0.0083, -0.2046, -0.0018)),
            ("tibia", (-0.0154, -0.4051, -0.0196)),
            ("calcn", (0.0436, 0.0315, -0.028)),
            ("calcn", (0.0708, 0.0176, -0.0263)),
            ("calcn", (0.1658, -0.0081, 0.0116)),
            ("toes", (-0.0019, -0.0078, 0.0147)),
            ("toes", (0.0285, -0.0071, 0.0215)),
            ("toes", (0.0441, -0.006, 0.0242)),
        ),
    ),
)  # fmt: skip
"""The 13 muscles of a leg, from gait14dof22 except for the two marked gait2392."""

FIBRE_REFERENCE: Final = {
    "abd": 0.93,
    "add": 0.64,
    "hamstrings": 0.94,
    "bifemsh": 1.17,
    "glutmax": 1.03,
    "iliopsoas": 1.09,
    "rectfem": 0.89,
    "vasti": 0.81,
    "gastroc": 1.00,
    "soleus": 1.00,
    "tibant": 0.97,
    "edl": 1.07,
    "fdl": 1.05,
}
"""Fibre length in the anatomical position over its optimum: (path - tendon slack length) / fibre of the sources.

Gastrocnemius and soleus would be at 1.20 and 1.08, where a rigid tendon leaves the calf so tight that quiet standing
needs the shin muscles; 1.00 is nearer to their sarcomeres (Ward et al. 2009, Clin Orthop Relat Res 467:1074).
"""

OUTLINE: Final = {
    "calcn": (((0.012, 0.005, 0.0), 0.035), ((0.158, -0.005, 0.032), 0.025), ((0.168, -0.005, -0.025), 0.025)),
    "toes": (((0.04, -0.008, 0.028), 0.02), ((0.05, -0.008, -0.022), 0.02)),
}
"""Spheres of the sole by segment, (centre, radius): heel, outer and inner ball, outer toes, great toe.

Their lowest points are in one plane, 30 mm below the origin of calcn, while the toes are straight.
"""
