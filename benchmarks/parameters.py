"""Gradients of every parameter of the model, in contact, against float64 central differences of C MuJoCo.

Beside each error stands what rounding alone does: how far the reference itself moves when the model's numbers are
rounded to float32 and the positions move by one unit in their last place. A float32 step cannot do better.

The humanoid is that of dm_control, needed for its files only: `pip install --no-deps dm-control`.
"""

import argparse
import copy
import dataclasses
import statistics
import warnings
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
from record import RESULTS, markdown_table, publish

from msk_ray.config import load_config
from msk_ray.envs import env_class
from msk_ray.step import Simulation
from msk_ray.step.check import GradientCheck, Oracle, check_gradients, make_states
from msk_ray.step.check.check import compare
from msk_ray.step.forward.parameters import names_of

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


def rounded(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy whose numbers are those of float32."""
    out = copy.copy(model)
    for struct in (out, out.opt):
        for name in dir(struct):
            value = getattr(struct, name)
            if isinstance(value, np.ndarray) and value.dtype == np.float64:
                value[...] = value.astype(np.float32)
    out.opt.timestep = float(np.float32(out.opt.timestep))
    return out


def rounding(
    model: mujoco.MjModel, substeps: int, worlds: set[int], args: argparse.Namespace
) -> dict[str, list[float]]:
    """By input, the relative change of the reference gradient by rounding, for the first of `worlds`."""
    names = names_of(model)
    reference, other = Oracle(model, substeps, names), Oracle(rounded(model), substeps, names)
    rng = np.random.default_rng([args.seed, 2])
    out: dict[str, list[float]] = {}
    states = make_states(model, "contact", args.worlds, args.seed)
    for world in sorted(worlds)[: args.rounding_states]:
        point = states[world]
        ulp = np.spacing(np.abs(point.qpos).astype(np.float32)) * rng.choice([-1.0, 1.0], model.nq)
        exact = reference.linearize(point)
        cotangent = rng.standard_normal(2 * model.nv + model.na)
        moved = other.linearize(dataclasses.replace(point, qpos=point.qpos + ulp)).pull_back(cotangent)
        for name, gradient in exact.pull_back(cotangent).items():
            smooth = ~exact.bent.get(name, np.zeros(len(gradient), bool))
            out.setdefault(name, []).append(compare(moved[name][smooth], gradient[smooth], 1.0)[0])
    return out


def _cell(result: GradientCheck, name: str, left_out: set[int], rounding: dict[str, list[float]]) -> list[str]:
    found = [r for r in result.of(name) if r.world not in left_out]
    # Without a cosine the reference vanishes: this input does nothing here.
    errors = [r.rel_error for r in found if r.cosine is not None]
    if not errors:
        return ["no effect" if found else "-", ""]
    moved = rounding.get(name, [])
    return [f"{statistics.median(errors):.0e} / {max(errors):.0e} ({len(errors)})", f"{statistics.median(moved):.0e}"]


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--models", nargs="+", choices=sorted(MODELS), default=list(MODELS), metavar="NAME")
    p.add_argument("--substeps", type=int, nargs="+", default=[1, 16])
    p.add_argument("--worlds", type=int, default=12, help="states in contact (default %(default)s)")
    p.add_argument("--solver-tolerance", type=float, default=1e-12, help="of Warp's solver (default %(default)s)")
    p.add_argument("--rounding-states", type=int, default=4, help="states for which rounding is measured")
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
        steep = steep_worlds(model, args)
        inputs = ["ctrl", "qpos", "qvel", *(["act"] if model.na else []), *names_of(model)]
        cells: dict[str, list[str]] = {name: [] for name in ("all", *inputs)}
        kinks = []
        for substeps in args.substeps:
            result = measure(model, substeps, args)
            moved = rounding(model, substeps, {r.world for r in result.results} - steep, args)
            for n in inputs:
                cells[n] += _cell(result, n, steep, moved)
            every = [r.rel_error for r in result.results if r.world not in steep and r.cosine is not None]
            all_moved = [change for n in inputs for change in moved[n] if change > 0.0]
            cells["all"] += [
                f"{statistics.median(every):.0e} / {max(every):.0e} ({len(every)})",
                f"{statistics.median(all_moved):.0e}",
            ]
            kinks.append(f"{result.parameter_kinks} at {substeps} substep(s)")
        header = ["input", *(text for s in args.substeps for text in (f"{s} substep(s)", "rounding"))]
        title = (
            f"{name}: relative error of gradients of parameters, median / largest (states); {len(steep)} states with "
            f"steep capsules left out; elements at kinks {', '.join(kinks)}"
        )
        table = markdown_table(header, [[n, *row] for n, row in cells.items()])
        publish("parameters", title, args.device, table, args.results)


if __name__ == "__main__":
    main()
