"""MyoSuite's model for tests, from the files that `make env` puts into `share/` of the environment.

They are not installed as a package: with them, `myoleg` would find other models than without.
"""

import re
import sys
import tempfile
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from needs import need_file

PACKAGE = Path(sys.prefix) / "share" / "myosuite"


@cache
def walk_model() -> str:
    """The path of `myoLegWalk-v0`'s model without meshes, materials, height field, cameras and lights, which takes a
    tenth of the time to compile, with the inertias of the whole model, of which some come from the meshes."""
    path = need_file(PACKAGE / "myosuite" / "simhive" / "myo_sim" / "leg" / "myolegs.xml", "make env")
    model = mujoco.MjModel.from_xml_path(str(path))
    spec = mujoco.MjSpec.from_file(str(path))
    for geom in list(spec.geoms):
        if geom.type in (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD):
            assert geom.type != mujoco.mjtGeom.mjGEOM_MESH or (geom.contype, geom.conaffinity) == (0, 0)
            spec.delete(geom)
        else:
            geom.material = ""
    for kind in ("meshes", "textures", "materials", "hfields", "cameras", "lights"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    for body in spec.bodies[1:]:
        compiled = model.body(body.name)
        body.explicitinertial, body.fullinertia = True, [np.nan] * 6
        body.mass, body.inertia = compiled.mass[0], compiled.inertia
        body.ipos, body.iquat = compiled.ipos, compiled.iquat
    spec.compile()
    out = Path(tempfile.mkdtemp(prefix="myosuite_model_")) / "myolegs.xml"  # below what goes with the tests
    out.write_text(re.sub(r' material="[^"]*"', "", spec.to_xml()))
    return str(out)
