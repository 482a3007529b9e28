"""Gradients of robot models from PyPI packages, with default buffers, against float64 differences of C MuJoCo.

The packages are only needed for their files: `pip install --no-deps mjlab gymnasium-robotics dm-control`.
"""

import argparse
import statistics
import time
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import mujoco
from record import RESULTS, markdown_table, publish

from msk_ray.errors import MskRayError, UnsupportedModelError
from msk_ray.gradcheck import GradientCheck, check_gradients
from msk_ray.physics.capacity import default_capacity, geometric_bound
from msk_ray.simulation import Simulation


class Model(NamedTuple):
    """A model file of a package."""

    package: str
    path: str

    def compile(self) -> mujoco.MjModel:
        """The compiled model, with a floor if it has none.

        Raises:
            FileNotFoundError: the package is not installed, or no longer has the file.
        """
        found = find_spec(self.package)
        if found is None or not found.submodule_search_locations:
            raise FileNotFoundError(f"{self.package} is not installed")
        spec = mujoco.MjSpec.from_file(str(Path(next(iter(found.submodule_search_locations))) / self.path))
        if not any(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in spec.worldbody.geoms):
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[40, 40, 1])
        return spec.compile()


MODELS = {
    "Unitree G1": Model("mjlab", "asset_zoo/robots/unitree_g1/xmls/g1.xml"),
    "Unitree Go1": Model("mjlab", "asset_zoo/robots/unitree_go1/xmls/go1.xml"),
    "I2RT YAM": Model("mjlab", "asset_zoo/robots/i2rt_yam/xmls/yam.xml"),
    "Shadow hand": Model("gymnasium_robotics", "envs/assets/hand/reach.xml"),
    "Shadow hand with block": Model("gymnasium_robotics", "envs/assets/hand/manipulate_block.xml"),
    "Shadow hand with egg": Model("gymnasium_robotics", "envs/assets/hand/manipulate_egg.xml"),
    "Shadow hand with pen": Model("gymnasium_robotics", "envs/assets/hand/manipulate_pen.xml"),
    "Adroit hand with pen": Model("gymnasium_robotics", "envs/assets/adroit_hand/adroit_pen.xml"),
    "Fetch": Model("gymnasium_robotics", "envs/assets/fetch/reach.xml"),
    "Humanoid": Model("dm_control", "suite/humanoid.xml"),
    "Humanoid CMU": Model("dm_control", "suite/humanoid_CMU.xml"),
    "Dog": Model("dm_control", "suite/dog.xml"),
    "Walker": Model("dm_control", "suite/walker.xml"),
    "Stacker": Model("dm_control", "suite/stacker.xml"),
    "Manipulator": Model("dm_control", "suite/manipulator.xml"),
}


def measure(model: mujoco.MjModel, args: argparse.Namespace) -> list[str]:
    """One row behind the name: sizes, what the adjoint covers, and errors."""
    begin = time.process_time()
    room, _ = default_capacity(model)
    probed = time.process_time() - begin
    bound = geometric_bound(model)
    sizes = [
        f"{model.nv}",
        "-" if bound is None else f"{bound.contacts} / {bound.rows}",
        f"{room.contacts} / {room.rows}",
        f"{probed:.2f}",
    ]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            sim = Simulation(model, args.worlds, args.substeps, device=args.device, tolerance=args.solver_tolerance)
            report = check_gradients(sim, states=args.states)
        except UnsupportedModelError as error:
            return [*sizes, "refused", "-", "-", "-", str(error).partition(". ")[0]]
        except MskRayError as error:
            return [*sizes, "failed", "-", "-", "-", str(error)]
    partly = any("partly exact" in str(warning.message) for warning in caught)
    counted = report.diagnostics.get("approximated_share", 0.0) > 0.0
    verdict = "partly exact" if partly else "approximated" if counted else "exact"
    return [*sizes, verdict, *_errors(report), _noteworthy(report)]


def _errors(report: GradientCheck) -> list[str]:
    worst = [r.rel_error for r in report.results]
    counts = f"{report.checked} ({report.kinks}, {report.forward_mismatches})"
    return [counts, f"{statistics.median(worst):.0e}", f"{max(worst):.0e}"] if worst else [counts, "-", "-"]


def _noteworthy(report: GradientCheck) -> str:
    named = {name: report.diagnostics.get(name, 0.0) for name in ("approximated_share", "solver_residual_max")}
    return f"approximated {named['approximated_share']:.2f}, residual {named['solver_residual_max']:.0e}"


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--models", nargs="+", choices=sorted(MODELS), default=list(MODELS), metavar="NAME")
    p.add_argument("--substeps", type=int, default=4)
    p.add_argument("--states", nargs="+", default=["standing", "contact"])
    p.add_argument("--worlds", type=int, default=4, help="states of each kind")
    p.add_argument("--solver-tolerance", type=float, default=1e-9, help="of Warp's solver (default %(default)s)")
    p.add_argument("--device", default="cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    rows = []
    for name in args.models:
        try:
            rows.append([name, *measure(MODELS[name].compile(), args)])
        except FileNotFoundError as error:
            rows.append([name, *["-"] * 4, "not tried", "-", "-", "-", str(error)])
        print(rows[-1], flush=True)
    header = [
        *("model", "nv", "bound: contacts / rows", "room given", "probe, CPU s", "adjoint"),
        *("states compared (kinks, mismatches)", "median error", "largest", "notes"),
    ]
    title = f"Models of PyPI packages, default buffers, {args.substeps} substeps: relative error of gradients"
    publish("foreign", title, args.device, markdown_table(header, rows), args.results)


if __name__ == "__main__":
    main()
