"""Errors of gradients through contacts of convex pairs, with the pair of geoms resting and sliding."""

import argparse
import statistics
import warnings
from pathlib import Path

import mujoco
import numpy as np
from record import RESULTS, markdown_table, publish

from msk_ray.gradcheck import Limits, Oracle, Point
from msk_ray.gradcheck.check import compare, forward_mismatch
from msk_ray.gradcheck.pullback import simulated_gradients
from msk_ray.simulation import Simulation, TapePerSubstep

PAIRS = [("mesh", "mesh"), ("box", "mesh"), ("cylinder", "capsule"), ("cylinder", "box")]
TABLES = {"mesh": 'mesh="slab"', "box": 'size=".4 .4 .1"', "cylinder": 'size=".4 .1"'}
THINGS = {"mesh": 'mesh="wedge"', "capsule": 'size=".06 .1"', "box": 'size=".08 .07 .06"'}
SLAB = " ".join(f"{x} {y} {z}" for x in (-0.4, 0.4) for y in (-0.4, 0.4) for z in (-0.1, 0.1))
WEDGE = "-.1 -.08 -.05 .1 -.08 -.05 0 .1 -.05 0 0 .12"
SETTLING, SLIDING = 500, 10
"""Steps for which a thing falls onto the table, and slides after a push."""


def scene(table: str, thing: str) -> mujoco.MjModel:
    """A thing above a table that a motor slides and two springs keep level."""
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep=".002" cone="elliptic"/>
        <default><geom friction=".6 .02 .01" solref=".02 1" solimp=".9 .95 .001 .5 2" density="500"/></default>
        <asset><mesh name="slab" vertex="{SLAB}"/><mesh name="wedge" vertex="{WEDGE}"/></asset>
        <worldbody><body><joint name="slide" type="slide" axis="1 0 0" damping="1"/>
        <joint axis="0 1 0" stiffness="100" damping="5"/><joint axis="1 0 0" stiffness="100" damping="5"/>
        <geom type="{table}" {TABLES[table]}/></body>
        <body pos="0 0 .4"><freejoint/><geom type="{thing}" {THINGS[thing]}/></body>
        </worldbody><actuator><motor joint="slide" gear="10"/></actuator></mujoco>"""
    )


def states(oracle: Oracle, count: int, sliding: bool) -> list[Point]:
    """States in contact: dropped in a random pose and settled, and then pushed if they should slide."""
    rng = np.random.default_rng(0)
    model, found = oracle.model, []
    while len(found) < count:
        qpos, quat = model.qpos0.copy(), rng.normal(size=4)
        qpos[3:6] = [0.1 * rng.normal(), 0.1 * rng.normal(), 0.32]
        qpos[6:10] = quat / np.linalg.norm(quat)
        point = Point(np.zeros(1), qpos, np.zeros(model.nv), np.zeros(0))
        for _ in range(SETTLING):
            point = oracle.step(point)
        if sliding:
            push = np.zeros(model.nv)
            push[3:5], push[8] = 0.7 * rng.normal(size=2), rng.normal()
            point = Point(point.ctrl, point.qpos, point.qvel + push, point.act)
            for _ in range(SLIDING):
                point = oracle.step(point)
        point = Point(
            *(v.astype(np.float32).astype(float) for v in (rng.normal(size=1), point.qpos, point.qvel, point.act))
        )
        if oracle.touching(point):
            found.append(point)
    return found


def row(table: str, thing: str, sliding: bool, substeps: int, worlds: int) -> list[str]:
    """One row of the table."""
    model, limits = scene(table, thing), Limits()
    points = states(Oracle(model, 1), worlds, sliding)
    sim = Simulation(model, worlds, substeps, TapePerSubstep(), "cpu", tolerance=1e-9)
    oracle = Oracle(model, substeps)
    cotangents = np.random.default_rng(1).standard_normal((worlds, 2 * model.nv)).astype(np.float32).astype(float)
    ends, gradients = simulated_gradients(sim, points, cotangents)
    share = sim.diagnostics()["approximated_share"]
    errors: dict[str, list[float]] = {"qpos": [], "qvel": [], "ctrl": []}
    for world, point in enumerate(points):
        reference = oracle.linearize(point)
        if forward_mismatch(oracle, point, reference.end, ends[world]) > limits.forward_mismatch:
            continue
        if reference.at_kink(limits.step_disagreement, limits.side_disagreement):
            continue
        expected = reference.pull_back(cotangents[world])
        for name, own in errors.items():
            own.append(compare(gradients[name][world], expected[name], float(np.linalg.norm(cotangents[world])))[0])
    figures = [f"{statistics.median(e):.0e} / {max(e):.0e}" if e else "-" for e in errors.values()]
    compared = f"{len(errors['qpos'])} of {worlds}"
    return [f"{table}, {thing}", "sliding" if sliding else "resting", str(substeps), f"{share:.0%}", *figures, compared]


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--substeps", type=int, nargs="+", default=[1, 4, 16])
    p.add_argument("--worlds", type=int, default=8, help="states of each kind")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    warnings.simplefilter("ignore")
    rows = []
    for table, thing in PAIRS:
        for sliding in (False, True):
            for substeps in args.substeps:
                rows.append(row(table, thing, sliding, substeps, args.worlds))
                print(rows[-1], flush=True)
    header = ["table, thing", "contact", "substeps", "approximated_share", "qpos", "qvel", "ctrl", "compared"]
    title = "Relative error of gradients through contacts of convex pairs, median / largest"
    publish("convex_contacts", title, "cpu", markdown_table(header, rows), args.results)


if __name__ == "__main__":
    main()
