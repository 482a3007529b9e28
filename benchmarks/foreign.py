"""Robot models that were not made for this package: which gradients are right, counted as approximated, or wrong?

Reads every MJCF file below the packages and folders that are named (`mujoco_playground`, a clone of mujoco_menagerie),
compiles those that are whole models, with a floor for what floats and has none, and compares one env step, with default
buffers, at a few states with float64 differences of C MuJoCo. Equal models count once. Files of meshes and textures
that a package downloads when it is first used are taken from the named folder that has most of them; a model whose
files are nowhere is left out by name, and none is changed. Models are measured in another process, which is ended where
one takes more than --seconds.

A row is written to --rows as soon as it is known, and a later run goes on from there; --again measures those with a
verdict once more. Convex collision runs at a tolerance of 1e-10, as in coverage.py.

Verdicts: right, every compared state is below --bound; rounding, what is above it is no more than ten times what the
reference moves when the state is rounded to float32, ten times what the float32 solver leaves unbalanced after it has
converged, or the difference of the reference's own one-sided slopes; counted, contacts are counted as approximated
there; told, a warning of the library names the cause; WRONG, none of these; refused, by name; not compared, every state
has a kink or another forward pass.
"""

import argparse
import hashlib
import json
import multiprocessing
import re
import statistics
import warnings
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from coverage import digest
from record import RESULTS, markdown_table, publish

from msk_ray.errors import MskRayError, UnsupportedModelError
from msk_ray.step import Simulation, check_gradients
from msk_ray.step.check.oracle import Oracle, Point
from msk_ray.step.check.states import make_states

Row = dict[str, Any]

VERDICTS = ("right", "rounding", "counted", "told", "WRONG", "refused", "not compared", "failed", "too slow")
_KNOWN_FILES = (".stl", ".obj", ".msh", ".png", ".skn", ".bin", ".xml")
_POINTER = b"version https://git-lfs"
_EPS = float(np.finfo(np.float32).eps)
_ROUNDINGS = 3
"""Roundings of each state."""
_AMPLIFIED = 10.0
"""How many times the effect of rounding the state an error may be that is laid to rounding: the step rounds as well."""
_NOT_CONVERGED = "stopped before it had converged"
"""What the library's warning says of a solver that left gradients wrong."""


def root_of(name: str) -> Path:
    """The folder of that path, or of the installed package of that name."""
    if Path(name).is_dir():
        return Path(name)
    found = find_spec(name)
    if found is None or not found.submodule_search_locations:
        raise SystemExit(f"{name} is neither a folder nor an installed package: pip install --no-deps it, or clone it")
    return Path(next(iter(found.submodule_search_locations)))


class Files:
    """Files of meshes, textures and parts of models in some folders, by name."""

    def __init__(self, roots: list[Path]) -> None:
        self._folders: dict[str, list[Path]] = {}
        for root in roots:
            for path in sorted(root.rglob("*")):
                if path.suffix.lower() in _KNOWN_FILES and not _is_pointer(path):
                    self._folders.setdefault(path.name, []).append(path.parent)

    def read(self, path: Path) -> mujoco.MjSpec:
        """The description in a file; a file that it includes and does not have beside it is taken from a folder.

        Raises:
            ValueError: it is no description of a model, or a file is nowhere.
        """
        included: dict[str, bytes] = {}
        while True:
            try:
                return mujoco.MjSpec.from_file(str(path), include=included)
            except ValueError as error:
                found = re.search(r"Error opening file '([^']+\.xml)'", str(error))
                name = Path(found[1]).name if found else ""
                if name in included or name not in self._folders:
                    raise
                folder = min(self._folders[name], key=lambda folder: _distance(folder, path))
                included[name] = (folder / name).read_bytes()

    def supply(self, spec: mujoco.MjSpec) -> list[str]:
        """Point a model at files that it does not have beside it; returns the names of those that are nowhere."""
        parts = [(mesh, spec.meshdir) for mesh in spec.meshes]
        parts += [(texture, spec.texturedir) for texture in spec.textures]
        parts += [(field, spec.meshdir) for field in spec.hfields]
        missing: dict[str, list[Any]] = {}
        for part, folder in parts:
            place = Path(spec.modelfiledir, folder, part.file)
            if part.file and (not place.is_file() or _is_pointer(place)):
                missing.setdefault(Path(part.file).name, []).append(part)
        while missing:
            holders = Counter(folder for name in missing for folder in set(self._folders.get(name, ())))
            if not holders:
                break
            best = min(holders, key=lambda folder: (-holders[folder], _distance(folder, Path(spec.modelfiledir))))
            for name in [name for name in missing if best in self._folders.get(name, ())]:
                for part in missing.pop(name):
                    part.file = str((best / name).resolve())
        return sorted(missing)


def _is_pointer(path: Path) -> bool:
    """Whether git has the file elsewhere."""
    with path.open("rb") as file:
        return file.read(len(_POINTER)) == _POINTER


def _distance(folder: Path, path: Path) -> tuple[int, str]:
    """How few folders two paths share, and the first one's name."""
    own, other = folder.resolve().parts, path.resolve().parts
    shared = next((i for i, pair in enumerate(zip(own, other, strict=False)) if pair[0] != pair[1]), len(own))
    return -shared, str(folder)


def compiled(path: Path, files: Files) -> mujoco.MjModel | str:
    """A file's model, with a floor if it floats and has none, or why there is no model."""
    try:
        spec = files.read(path)
        missing = files.supply(spec)
        if missing:
            return f"files missing: {', '.join(missing[:3])}{' …' if len(missing) > 3 else ''}"
        floats = any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in spec.joints)
        if floats and not any(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in spec.worldbody.geoms):
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[40, 40, 1])
        spec.option.ccd_tolerance = 1e-10
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        return f"does not compile: {str(error).splitlines()[0]}"
    return model if model.nv else "cannot move"


def signature(model: mujoco.MjModel) -> str:
    """The same for models that differ in names and looks only."""
    option = model.opt
    settings = (option.timestep, option.iterations, option.ls_iterations, option.cone, option.integrator)
    parts = (model.qpos0, model.geom_contype, model.geom_conaffinity, model.geom_friction, model.jnt_range)
    text = f"{settings} {digest(model)}".encode() + b"".join(part.tobytes() for part in parts)
    return hashlib.sha256(text).hexdigest()


def measured(model: mujoco.MjModel, args: argparse.Namespace) -> Row:
    """What is known of one model: its verdict, and the figures of each kind of state."""
    row: Row = {"nv": int(model.nv), "iterations": [int(model.opt.iterations), int(model.opt.ls_iterations)]}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            sim = Simulation(model, args.worlds, args.substeps, device=args.device, tolerance=args.solver_tolerance)
        except UnsupportedModelError as error:
            return row | {"verdict": "refused", "note": str(error).partition(". ")[0]}
        except MskRayError as error:
            return row | {"verdict": "failed", "note": str(error)}
        kinds = {kind: _at(sim, kind, args.bound) for kind in args.states}
    told = sorted({str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)})
    return row | {"kinds": kinds, "told": told} | judged(kinds, told, args.bound)


def _at(sim: Simulation, kind: str, bound: float) -> Row:
    """The figures of one kind of state."""
    try:
        found = check_gradients(sim, states=[kind])
    except (MskRayError, mujoco.FatalError) as error:
        return {"failed": str(error)}
    worst: dict[int, float] = {}
    for result in found.results:
        worst[result.world] = max(worst.get(result.world, 0.0), result.rel_error)
    named = ("approximated_share", "solver_unconverged_share", "solver_residual_max")
    return {
        "checked": found.checked,
        "kinks": found.kinks,
        "mismatches": found.forward_mismatches,
        "nonfinite": len(found.nonfinite),
        "errors": list(worst.values()),
        "doubts": [doubt(sim, kind, world) if error > bound else 0.0 for world, error in worst.items()],
    } | {name: found.diagnostics.get(name, 0.0) for name in named}


def doubt(sim: Simulation, kind: str, world: int) -> float:
    """How far a state's reference may be off, relative, by float32 inputs or a kink nearby that is still allowed."""
    oracle, rng = Oracle(sim.model, sim.substeps), np.random.default_rng(0)
    point = make_states(sim.model, kind, sim.nworld, seed=0)[world]
    cotangent = rng.standard_normal(2 * sim.model.nv + sim.model.na)
    exact = oracle.linearize(point)
    gradients, moved = exact.pull_back(cotangent), 0.0
    for _ in range(_ROUNDINGS):
        parts = (point.ctrl, point.qpos, point.qvel, point.act)
        near = Point(*(part * (1.0 + _EPS * rng.uniform(-0.5, 0.5, part.shape)) for part in parts))
        for name, gradient in oracle.linearize(near).pull_back(cotangent).items():
            size = float(np.linalg.norm(gradients[name]))
            moved = max(moved, float(np.linalg.norm(gradient - gradients[name])) / size if size else 0.0)
    return max(_AMPLIFIED * moved, *exact.side_disagreement.values())


def judged(kinds: Row, told: list[str], bound: float) -> Row:
    """The verdict on a model, and what there is to say of it."""
    known = [figures for figures in kinds.values() if "failed" not in figures]
    failed = [f"{kind}: {figures['failed']}" for kind, figures in kinds.items() if "failed" in figures]
    if not known:
        return {"verdict": "failed", "note": "; ".join(failed)}
    above = [figures for figures in known if figures["nonfinite"] or max(figures["errors"], default=0.0) > bound]
    silent = [figures for figures in above if not figures["approximated_share"] and not _explained(figures, bound)]
    # Another forward pass because the solver was stopped is the gradient of another step.
    stopped = [figures for figures in known if figures["mismatches"] and figures["solver_unconverged_share"]]
    if silent or stopped:
        unsolved = all(figures["solver_unconverged_share"] for figures in silent)
        verdict = "told" if unsolved and any(_NOT_CONVERGED in text for text in told) else "WRONG"
    elif above:
        verdict = "rounding" if all(_explained(figures, bound) for figures in above) else "counted"
    else:
        verdict = "right" if any(figures["checked"] for figures in known) else "not compared"
    notes = [*failed]
    if stopped:
        notes.append(f"solver not converged in {max(f['solver_unconverged_share'] for f in stopped):.0%}")
    return {"verdict": verdict, "note": "; ".join(notes)}


def _explained(figures: Row, bound: float) -> bool:
    """Whether every error above the bound may be the reference's, or the rounding of a solver that has converged."""
    left = 0.0 if figures["solver_unconverged_share"] else _AMPLIFIED * figures["solver_residual_max"]
    pairs = zip(figures["errors"], figures["doubts"], strict=True)
    return not figures["nonfinite"] and all(error <= max(bound, left, doubt) for error, doubt in pairs)


def serve(connection: Connection, args: argparse.Namespace, roots: list[Path]) -> None:
    """Measure the files that are asked for, until told None; a known signature is not measured again."""
    files = Files(roots)
    while (request := connection.recv()) is not None:
        path, signatures = request
        model = compiled(path, files)
        if isinstance(model, str):
            connection.send({"verdict": "no model", "note": model})
            continue
        own = signature(model)
        if own in signatures:
            connection.send({"verdict": "twice", "note": ""})
        elif model.nv > args.largest:
            connection.send({"verdict": "too slow", "note": f"{model.nv} degrees of freedom", "nv": int(model.nv)})
        else:
            connection.send({"signature": own} | measured(model, args))


class Worker:
    """A process that measures models, started again where one takes too long or ends it."""

    def __init__(self, args: argparse.Namespace, roots: list[Path]) -> None:
        self._args, self._roots = args, roots
        self._context = multiprocessing.get_context("spawn")
        self._process: Any = None

    def measure(self, path: Path, signatures: set[str]) -> Row:
        """The row of one file."""
        if self._process is None:
            self._connection, other = self._context.Pipe()
            self._process = self._context.Process(target=serve, args=(other, self._args, self._roots), daemon=True)
            self._process.start()
            other.close()
        self._connection.send((path, signatures))
        try:
            if self._connection.poll(self._args.seconds):
                return dict(self._connection.recv())
            row = {"verdict": "too slow", "note": f"more than {self._args.seconds} s"}
        except EOFError:
            self._process.join()
            row = {"verdict": "failed", "note": f"the process ended with {self._process.exitcode}"}
        self.end()
        return row

    def end(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._connection.close()
            self._process = None


def sources(names: list[str]) -> Iterator[tuple[str, Path]]:
    """(name, file) of every MJCF file of packages and folders."""
    for name in names:
        root = root_of(name)
        for path in sorted(root.rglob("*.xml")):
            yield f"{Path(name).name}/{path.relative_to(root)}", path


def gathered(args: argparse.Namespace) -> dict[str, Row]:
    """All rows by model, those written by earlier runs included."""
    lines = args.rows.read_text().splitlines() if args.rows.exists() else []
    rows: dict[str, Row] = {row["model"]: _rejudged(row, args.bound) for row in map(json.loads, lines)}
    known = {name for name, row in rows.items() if row["verdict"] not in args.again}
    signatures = {rows[name]["signature"] for name in known if "signature" in rows[name]}
    worker = Worker(args, [root_of(name) for name in args.roots])
    for name, path in sources(args.roots):
        if name in known or (args.only and not re.search(args.only, name)):
            continue
        if name in rows or not args.again:
            rows[name] = {"model": name, **worker.measure(path, signatures)}
            signatures |= {rows[name]["signature"]} if "signature" in rows[name] else set()
            with args.rows.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[name]) + "\n")
            print(name, rows[name]["verdict"], rows[name].get("note", ""), flush=True)
    worker.end()
    return rows


def _rejudged(row: Row, bound: float) -> Row:
    """The row with the verdict that follows from its figures by today's rules."""
    return row | judged(row["kinds"], row["told"], bound) if "kinds" in row else row


def _cells(row: Row) -> list[str]:
    """The cells of a model's row."""
    known = [figures for figures in row.get("kinds", {}).values() if "failed" not in figures]
    errors = [error for figures in known for error in figures["errors"]]
    counts = [str(sum(figures[name] for figures in known)) for name in ("checked", "kinks", "mismatches")]
    counted = max((figures["approximated_share"] for figures in known), default=0.0)
    return [
        row["model"],
        str(row.get("nv", "-")),
        " / ".join(map(str, row.get("iterations", ["-"]))),
        row["verdict"],
        f"{counts[0]} ({counts[1]}, {counts[2]})" if known else "-",
        f"{statistics.median(errors):.0e}" if errors else "-",
        f"{max(errors):.0e}" if errors else "-",
        f"{counted:.0%}" if counted else "-",
        row.get("note", "").replace("|", "/"),
    ]


def tables(rows: dict[str, Row]) -> str:
    """Verdicts by package or folder, what is refused, and every model."""
    models = [row for row in rows.values() if row["verdict"] in VERDICTS]
    places = list(dict.fromkeys(row["model"].partition("/")[0] for row in models))
    by_place = []
    for place in (*places, "all"):
        own = [row for row in models if place in (row["model"].partition("/")[0], "all")]
        counts = Counter(row["verdict"] for row in own)
        by_place.append([place, str(len(own)), *(str(counts[verdict]) for verdict in VERDICTS)])
    known = [figures for row in models for figures in row.get("kinds", {}).values() if "failed" not in figures]
    errors = [error for figures in known for error in figures["errors"]]
    shares = ", ".join(
        f"{sum(e <= bound for e in errors) / max(1, len(errors)):.1%} below {bound:g}" for bound in (1e-4, 1e-3, 1e-2)
    )
    kinks, mismatches = (sum(figures[name] for figures in known) for name in ("kinks", "mismatches"))
    dropped = Counter(row["note"].partition(":")[0] for row in rows.values() if row["verdict"] == "no model")
    header = ["model", "nv", "iterations / of the line search", "verdict", "states compared (kinks, mismatches)"]
    return "\n\n".join(
        (
            markdown_table(["from", "models", *VERDICTS], by_place),
            f"{len(errors)} states compared; {kinks} left out at kinks, {mismatches} where MuJoCo Warp's own step "
            f"differs from C MuJoCo's. Largest error over all inputs: {shares}. Files that are no model: "
            + ", ".join(f"{count} {reason}" for reason, count in dropped.most_common()),
            markdown_table([*header, "median error", "largest", "counted", "note"], [_cells(row) for row in models]),
        )
    )


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument(
        "roots", nargs="+", metavar="PACKAGE_OR_FOLDER", help="where models are; meshes are looked for in all"
    )
    p.add_argument("--rows", type=Path, default=Path("foreign.jsonl"), help="rows known so far (default %(default)s)")
    p.add_argument("--only", help="models whose name matches this regular expression")
    p.add_argument("--again", nargs="+", default=[], choices=[*VERDICTS, "no model"], help="verdicts to measure anew")
    p.add_argument("--substeps", type=int, default=4)
    p.add_argument("--states", nargs="+", default=["standing", "contact"])
    p.add_argument("--worlds", type=int, default=2, help="states of each kind")
    p.add_argument("--bound", type=float, default=1e-3, help="relative error that is right (default %(default)s)")
    p.add_argument("--largest", type=int, default=200, help="degrees of freedom above which no error is measured")
    p.add_argument("--seconds", type=float, default=300, help="limit for one model (default %(default)s)")
    p.add_argument("--solver-tolerance", type=float, default=1e-9, help="of Warp's solver (default %(default)s)")
    p.add_argument("--device", default="cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the tables are appended in")
    args = p.parse_args()
    rows = gathered(args)
    title = f"Models not made for this package, default buffers, {args.substeps} substeps: relative error of gradients"
    publish("foreign", title, args.device, tables(rows), args.results)


if __name__ == "__main__":
    main()
