"""Every model of some PyPI packages: is its gradient exact, approximated or refused, and how large is its error?

Reads all MJCF files of the packages named in GROUPS and compiles those that are whole models with degrees of freedom;
myo_sim also composes models in Python, which are read from its registry. Equal models count once. The packages are only
needed for their files: `pip install --no-deps gymnasium gymnasium-robotics dm-control mjlab robosuite gym-aloha
robopianist myo-sim musclemimic-models`. What is not installed is named and left out. A model's row is written to --rows
as soon as it is known, and a later run goes on from there.

Convex collision runs at a tolerance of 1e-10, so that the errors are those of the gradient: at MuJoCo's default of 1e-6
C MuJoCo's normals on curved surfaces are off by up to 5e-3 rad, and its differences with them.
"""

import argparse
import hashlib
import json
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import mujoco_warp as mjw
import numpy as np
from record import RESULTS, markdown_table, publish

from msk_ray.errors import MskRayError
from msk_ray.step import Simulation, check_gradients
from msk_ray.step.adjoint.coverage.check import unsupported

GROUPS = {
    "robots": ("gymnasium_robotics", "mjlab", "robosuite", "gym_aloha", "robopianist"),
    "muscle models": ("myo_sim", "musclemimic_models"),
    "benchmarks": ("gymnasium", "dm_control", "mujoco_warp"),
}


class Source(NamedTuple):
    """Where a model is from; `load` gives its MjSpec, and raises ValueError for a part of other files."""

    group: str
    name: str
    load: Callable[[], mujoco.MjSpec]


def sources() -> Iterator[Source]:
    """Every MJCF file and composed model; a package that is not installed is named on the way."""
    for group, packages in GROUPS.items():
        for package in packages:
            found = find_spec(package)
            if found is None or not found.submodule_search_locations:
                print(f"{package} is not installed: left out", flush=True)
                continue
            root = Path(next(iter(found.submodule_search_locations)))
            for path in sorted(root.rglob("*.xml")):
                name = f"{package}/{path.relative_to(root)}"
                yield Source(group, name, partial(mujoco.MjSpec.from_file, str(path)))
            if package == "myo_sim":
                load_spec = import_module("myo_sim").load_spec
                for name in sorted(import_module("myo_sim.build.compose").MODEL_REGISTRY):
                    yield Source(group, f"myo_sim.load_spec({name!r})", partial(load_spec, name))


def compiled(source: Source) -> mujoco.MjModel | None:
    """A source's model with a floor below it, or None for a part of other files or a model that cannot move."""
    try:
        spec = source.load()
        if not any(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in spec.worldbody.geoms):
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[40, 40, 1])
        spec.option.ccd_tolerance = 1e-10
        model = spec.compile()
    except (ValueError, mujoco.FatalError):
        return None
    return model if model.nv else None


def digest(model: mujoco.MjModel) -> str:
    """The same for models that differ in names only."""
    parts = (getattr(model, name) for name in ("body_pos", "body_mass", "jnt_axis", "geom_size", "actuator_gear"))
    return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()


def errors_at(model: mujoco.MjModel, substeps: int, args: argparse.Namespace) -> dict[str, Any]:
    """The errors over one number of substeps, and which kinds of state there are none of, and why."""
    out: dict[str, Any] = {"checked": 0, "kinks": 0, "mismatches": 0, "nonfinite": 0, "approximated_share": 0.0}
    errors: list[float] = []
    failed: list[str] = []
    try:
        sim = Simulation(model, args.worlds, substeps, device=args.device, tolerance=args.solver_tolerance)
    except MskRayError as error:
        return out | {"worst": None, "median": None, "failed": [str(error)]}
    for kind in args.states:
        try:
            result = check_gradients(sim, states=[kind])
        except (MskRayError, mujoco.FatalError) as error:
            failed.append(f"{kind}: {error}")
            continue
        errors += [r.rel_error for r in result.results]
        out["checked"] += result.checked
        out["kinks"] += result.kinks
        out["mismatches"] += result.forward_mismatches
        out["nonfinite"] += len(result.nonfinite)
        share = result.diagnostics.get("approximated_share", 0.0)
        out["approximated_share"] = max(out["approximated_share"], share)
    return out | {
        "worst": max(errors, default=None),
        "median": float(np.median(errors)) if errors else None,
        "failed": failed,
    }


def refusals(model: mujoco.MjModel) -> list[str]:
    """What the adjoint or mujoco_warp refuses of a model."""
    try:
        mjw.put_model(model)
    except (NotImplementedError, ValueError) as error:
        return [f"mujoco_warp: {error}"]
    return sorted(unsupported(model))


def row_of(group: str, name: str, model: mujoco.MjModel, args: argparse.Namespace) -> dict[str, Any]:
    """What is known of one model."""
    row: dict[str, Any] = {"group": group, "model": name, "nv": model.nv, "digest": digest(model)}
    refused = refusals(model)
    verdict = "refused" if refused else "exact"
    row |= {"verdict": verdict, "refused": refused}
    if not refused and model.nv <= args.largest:
        begin = time.process_time()
        row["errors"] = {str(n): errors_at(model, n, args) for n in args.substeps}
        if verdict == "exact" and any(found["approximated_share"] for found in row["errors"].values()):
            row["verdict"] = "approximated"
        row["seconds"] = round(time.process_time() - begin, 1)
    return row


def gather_rows(args: argparse.Namespace) -> list[dict[str, Any]]:
    """All rows, those written by earlier runs included."""
    rows = [json.loads(line) for line in args.rows.read_text().splitlines()] if args.rows.exists() else []
    known = {row["model"] for row in rows}
    digests = {row["digest"] for row in rows if row["digest"]}
    for source in sources():
        group, name, _ = source
        if name in known or (args.only and args.only not in name):
            continue
        model = compiled(source)
        if model is None:
            row: dict[str, Any] = {"group": group, "model": name, "verdict": "no model", "digest": ""}
        elif digest(model) in digests:
            row = {"group": group, "model": name, "verdict": "twice", "digest": ""}
        else:
            row = row_of(group, name, model, args)
            digests.add(row["digest"])
        rows.append(row)
        with args.rows.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        print(json.dumps({key: value for key, value in row.items() if key != "digest"}), flush=True)
    return rows


def _worst(row: dict[str, Any], substeps: int) -> str:
    found = row.get("errors", {}).get(str(substeps))
    if found is None:
        return "-"
    worst = "-" if found["worst"] is None else f"{found['worst']:.0e}"
    counted = f", {found['approximated_share']:.0%} counted" if found["approximated_share"] else ""
    return f"{worst} ({found['checked']}, {found['kinks']}, {found['mismatches']}{counted})"


def tables(rows: list[dict[str, Any]], substeps: list[int]) -> str:
    """Shares by group, what is refused and how often, and every model."""
    models = [row for row in rows if row["verdict"] not in ("no model", "twice")]
    verdicts = ("exact", "approximated", "refused")
    shares = []
    for group in (*GROUPS, None):
        own = [row for row in models if group in (row["group"], None)]
        counts = Counter(row["verdict"] for row in own)
        cells = [f"{counts[v]} ({counts[v] / max(1, len(own)):.0%})" for v in verdicts]
        shares.append([group or "all", str(len(own)), *cells])
    reasons = Counter(reason for row in models for reason in row["refused"])
    every = [
        [row["model"], str(row["nv"]), row["verdict"], *(_worst(row, n) for n in substeps), "; ".join(row["refused"])]
        for row in models
    ]
    columns = [f"largest error, {n} substeps (states, kinks, mismatches)" for n in substeps]
    return "\n\n".join(
        (
            markdown_table(["group", "models", *verdicts], shares),
            markdown_table(["refused for", "models"], [[name, str(count)] for name, count in reasons.most_common()]),
            markdown_table(["model", "nv", "gradient", *columns, "refused for"], every),
        )
    )


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--rows", type=Path, default=Path("coverage.jsonl"), help="rows known so far (default %(default)s)")
    p.add_argument("--only", help="models whose name contains this")
    p.add_argument("--substeps", type=int, nargs="+", default=[1, 4, 16])
    p.add_argument("--states", nargs="+", default=["standing", "contact"])
    p.add_argument("--worlds", type=int, default=2, help="states of each kind")
    p.add_argument("--largest", type=int, default=200, help="degrees of freedom above which no error is measured")
    p.add_argument("--solver-tolerance", type=float, default=1e-9, help="of Warp's solver (default %(default)s)")
    p.add_argument("--device", default="cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the tables are appended in")
    args = p.parse_args()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = gather_rows(args)
    publish(
        "coverage",
        "Models of PyPI packages and their gradients",
        args.device,
        tables(rows, args.substeps),
        args.results,
    )


if __name__ == "__main__":
    main()
