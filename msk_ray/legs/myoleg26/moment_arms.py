"""Moment arms of a leg's muscles, and the published ranges they are compared with."""

from typing import Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

_HIP: Final = "published models in the anatomical position ±25 % (gait14dof22 and MyoLeg26): "


class PublishedArm(NamedTuple):
    """Range of a moment arm over a range of joint angles, the other joints in the anatomical position."""

    muscle: str
    joint: str
    angles: tuple[float, float]
    """Joint angles [degrees] from and to."""
    least: float
    """Range [m], positive where the muscle turns the joint in its positive sense."""
    most: float
    source: str


_QUADRICEPS: Final = (
    "patellar tendon 20 to 50 mm in vivo (Sheehan 2007, PMC2753825); effective arm 31 to 47 mm (PMC4662057)"
)
_KNEE: Final = "Spoor & van Leeuwen 1992 (J Biomech 25:201): semimembranosus 20 to 40 mm, semitendinosus 40 to 55 mm"
_ACHILLES: Final = (
    "in vivo: 35 to 38 mm (Manal 2013, PMC3871454), 43 to 56 mm (Maganaris 2000, Eur J Appl Physiol 83:363)"
)
_TIBANT: Final = "in vivo: 29 to 45 mm at rest, 9 to 15 mm more when contracting (Maganaris 2000, J Biomech 33:375)"
_DIGITS: Final = "path of gait2392, ±40 % for a fixed subtalar joint; Spoor et al. 1990 (J Biomech 23:1247)"

PUBLISHED: Final = (
    PublishedArm("vasti", "knee_angle", (-90, -5), 0.020, 0.050, _QUADRICEPS),
    PublishedArm("rectfem", "knee_angle", (-90, -5), 0.020, 0.050, _QUADRICEPS),
    PublishedArm("hamstrings", "knee_angle", (-90, -5), -0.055, -0.020, _KNEE),
    PublishedArm("bifemsh", "knee_angle", (-90, -5), -0.050, -0.015, _KNEE + "; biceps 20 mm"),
    PublishedArm("gastroc", "knee_angle", (-75, -5), -0.020, -0.012, "Spoor & van Leeuwen 1992: 12 to 20 mm"),
    PublishedArm("gastroc", "ankle_angle", (-20, 20), -0.056, -0.0346, _ACHILLES),
    PublishedArm("soleus", "ankle_angle", (-20, 20), -0.056, -0.0346, _ACHILLES),
    PublishedArm("tibant", "ankle_angle", (-20, 15), 0.029, 0.060, _TIBANT),
    PublishedArm("edl", "ankle_angle", (-20, 15), 0.020, 0.050, _DIGITS),
    PublishedArm("fdl", "ankle_angle", (-20, 15), -0.015, -0.004, _DIGITS),
    PublishedArm("iliopsoas", "hip_flexion", (-15, 15), 0.0236, 0.0525, _HIP + "31 to 42 mm"),
    PublishedArm("rectfem", "hip_flexion", (-15, 15), 0.0310, 0.0523, _HIP + "42 mm"),
    PublishedArm("glutmax", "hip_flexion", (-15, 15), -0.0696, -0.0418, _HIP + "56 mm"),
    PublishedArm("hamstrings", "hip_flexion", (-15, 15), -0.0610, -0.0366, _HIP + "49 mm"),
    PublishedArm("abd", "hip_adduction", (-15, 10), -0.0551, -0.0331, _HIP + "44 mm"),
    PublishedArm("add", "hip_adduction", (-15, 10), 0.0569, 0.0949, _HIP + "76 mm"),
)  # fmt: skip


def moment_arms(
    model: mujoco.MjModel, muscle: str, joint: str, angles: NDArray[np.float64], side: str = "r"
) -> NDArray[np.float64]:
    """Moment arm [m] of a muscle about a hinge at each of `angles` [rad]: minus the slope of its path's length."""
    data = mujoco.MjData(model)
    column, row = model.joint(f"{joint}_{side}").dofadr[0], model.tendon(f"{muscle}_{side}").id
    step = 1e-6
    arms = []
    for angle in angles:
        lengths = []
        for moved in (angle + step, angle - step):
            data.qpos[:] = model.qpos0
            data.qpos[column] = moved
            mujoco.mj_fwdPosition(model, data)
            lengths.append(float(data.ten_length[row]))
        arms.append(-(lengths[0] - lengths[1]) / (2.0 * step))
    return np.array(arms)
