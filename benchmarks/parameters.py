"""Gradients of every parameter of the model, in contact, against float64 central differences of C MuJoCo.

The humanoid is that of dm_control, needed for its files only: `pip install --no-deps dm-control`.
"""

import argparse
import statistics
import warnings
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
from record import RESULTS, markdown_table, publish

from msk_ray.config import load_config
from msk_ray.envs import env_class
from msk_ray.gradcheck import GradientCheck, check_gradients, make_states
from msk_ray.physics.parameters import names_of
from msk_ray.simulation import Simulation

SERVO_ARM = """
<mujoco>
  <option timestep="0.004" cone="elliptic"/>
  <default>
    <joint damping=".4" armature=".02" frictionloss=".1" limited="true" range="-100 100" stiffness=".5" springref="10"/>
    <geom friction=".7 .01 .002" solref=".03 1"/>
    <position kp="60" kv="3" ctrlrange="-2 2" forcerange="-40 40"/>
  </default>
  <worldbody>
    <geom name="table" type="plane" size="2 2 .1" friction=".9 .02 .004"/>
    <body pos="0 0 .35">
      <joint name="turn" axis="0 0 1"/>
      <geom type="cylinder" size=".06 .05" mass="1.2"/>
      <body pos="0 0 .06">
        <joint name="shoulder" axis="0 1 0"/>
        <geom type="capsule" size=".035" fromto="0 0 0 .3 0 0" mass=".9"/>
        <body pos=".3 0 0">
          <joint name="elbow" axis="0 1 0"/>
          <geom type="capsule" size=".03" fromto="0 0 0 .25 0 0" mass=".6"/>
          <body pos=".25 0 0">
            <joint name="wrist" axis="1 .2 0"/>
            <geom type="box" size=".05 .03 .02" pos=".05 0 .01" mass=".3"/>
            <geom type="sphere" size=".03" pos=".12 0 0" mass=".1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="turn"/><position joint="shoulder"/><position joint="elbow"/><position joint="wrist" kp="20"/>
  </actuator>
</mujoco>"""


_STEEP = 0.82
"""Cosine between a capsule and a plane's normal above which it is left out: cos 30°, less what a few steps turn it."""


def _configured(name: str) -> mujoco.MjModel:
    config = load_config(Path(__file__).parents[1] / "configs" / f"{name}.yaml")
    return env_class(config.env).build_model(config.env, config.physics)


def _humanoid() -> mujoco.MjModel:
    found = find_spec("dm_control")
    if found is None or not found.submodule_search_locations:
        raise FileNotFoundError("dm_control is not installed")
    return mujoco.MjModel.from_xml_path(str(Path(next(iter(found.submodule_search_locations))) / "suite/humanoid.xml"))


MODELS = {
    "ant": lambda: _configured("ant"),
    "ant_published": lambda: _configured("ant_published"),
    "servo arm": lambda: mujoco.MjModel.from_xml_string(SERVO_ARM),
    "myoleg26": lambda: _configured("myoleg26"),
    "humanoid (dm_control)": _humanoid,
}


def measure(model: mujoco.MjModel, substeps: int, args: argparse.Namespace) -> GradientCheck:
    """The comparison of all parameters at one number of substeps."""
    # Which of two equal frictions counts in a contact has no derivative.
    model.geom_friction *= np.linspace(1.0, 1.3, model.ngeom)[:, None]
    sim = Simulation(model, args.worlds, substeps, device=args.device, tolerance=args.solver_tolerance)
    return check_gradients(sim, states=("contact",), seed=args.seed, parameters=names_of(model))


def steep_worlds(model: mujoco.MjModel, args: argparse.Namespace) -> set[int]:
    """States in which a capsule touches a plane more than 60° off it: mujoco_warp's contact frame is another there.

    A step is the same, but not its slope by one of the two frictions, nor by the plane's orientation.
    """
    data, found = mujoco.MjData(model), set()
    for world, point in enumerate(make_states(model, "contact", args.worlds, args.seed)):
        data.qpos[:] = point.qpos
        mujoco.mj_fwdPosition(model, data)
        for contact in data.contact:
            types = model.geom_type[contact.geom]
            if tuple(types) == (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_CAPSULE):
                axis = data.geom_xmat[contact.geom[1]].reshape(3, 3)[:, 2]
                if abs(axis @ contact.frame[:3]) > _STEEP:
                    found.add(world)
    return found


def _cell(result: GradientCheck, name: str, left_out: set[int]) -> str:
    errors = [r.rel_error for r in result.of(name) if r.world not in left_out]
    return f"{statistics.median(errors):.0e} / {max(errors):.0e} ({len(errors)})" if errors else "-"


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--models", nargs="+", choices=sorted(MODELS), default=list(MODELS), metavar="NAME")
    p.add_argument("--substeps", type=int, nargs="+", default=[1, 16])
    p.add_argument("--worlds", type=int, default=12, help="states in contact (default %(default)s)")
    p.add_argument("--solver-tolerance", type=float, default=1e-12, help="of Warp's solver (default %(default)s)")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--device", default="cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the tables are appended in")
    args = p.parse_args()
    warnings.simplefilter("ignore")
    for name in args.models:
        try:
            model = MODELS[name]()
        except FileNotFoundError as error:
            print(f"{name}: {error}", flush=True)
            continue
        results = [measure(model, substeps, args) for substeps in args.substeps]
        inputs = ["ctrl", "qpos", "qvel", *(["act"] if model.na else []), *names_of(model)]
        steep = steep_worlds(model, args)
        rows = [[n, *(_cell(r, n, steep) for r in results)] for n in inputs]
        states = f"{len(steep)} states with steep capsules left out; elements at kinks "
        states += ", ".join(
            f"{r.parameter_kinks} at {s} substep(s)" for r, s in zip(results, args.substeps, strict=True)
        )
        header = ["input", *(f"{s} substep(s)" for s in args.substeps)]
        title = f"{name}: relative error of gradients of parameters, median / largest (states); {states}"
        publish("parameters", title, args.device, markdown_table(header, rows), args.results)


if __name__ == "__main__":
    main()
