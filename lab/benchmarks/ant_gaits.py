"""How does an ant run? Flight, stride and locked joints of trained policies, from their deterministic trajectories.

Physics and initial states are those of the evaluation. Contacts are those C MuJoCo finds in the recorded states.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from record import RESULTS, markdown_table, publish

from msk_ray.cli import run
from msk_ray.errors import ConfigError
from msk_ray.evaluate.measure import Bench, Request
from msk_ray.training import load_policy
from msk_ray.visualize.recording import record
from msk_ray.visualize.render import States

SETTLED = 2.5
"""Time after which the gait is measured [s]."""
SLOWEST = 0.5
"""Frequency below which an oscillation does not count as a stride [1/s]."""
LOCKED = 0.75
"""Share of the time at an end of its range above which a joint is named."""
MARGIN = 0.05
"""Distance within which a joint counts as at the end of its range [rad]: the limits of these models are soft."""


@dataclass(frozen=True)
class Gait:
    """One episode, once it has settled."""

    vx: float
    """Forward velocity [m/s]."""
    flight: float
    """Share of the time without any contact."""
    rate: float
    """Strides a second: where the joints' power spectrum, summed, has its peak."""
    at_end: np.ndarray
    """Share of the time that each hinge is at an end of its range, (J,)."""
    past: np.ndarray
    """How far each is past the nearer end [rad], mean over time, (J,); negative inside the range."""


def gait(states: States, timestep: float) -> Gait:
    """Describe one episode.

    Args:
        states: of a model with a free root and hinges, every `timestep`.
        timestep: of an env step [s].
    """
    model, qpos = states.model, states.qpos[round(SETTLED / timestep) :]
    data = mujoco.MjData(model)
    touching = 0
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        touching += bool((data.contact.dist[: data.ncon] < 0.0).any())
    joints = qpos[:, 7:]
    power = (np.abs(np.fft.rfft(joints - joints.mean(0), axis=0)) ** 2).sum(1)
    rates = np.fft.rfftfreq(len(joints), timestep)
    fast = rates >= SLOWEST
    low, high = np.where(model.jnt_limited[1:, None], model.jnt_range[1:], [-np.inf, np.inf]).T
    return Gait(
        vx=float(qpos[-1, 0] - qpos[0, 0]) / ((len(qpos) - 1) * timestep),
        flight=1.0 - touching / len(qpos),
        rate=float(rates[fast][power[fast].argmax()]),
        past=np.maximum(low - joints, joints - high).mean(0),
        at_end=((joints < low + MARGIN) | (joints > high - MARGIN)).mean(0),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("checkpoints", nargs="+", type=Path, help="policies (.pt)")
    p.add_argument("--worlds", type=int, default=16)
    p.add_argument("--steps", type=int, default=600, help="env steps an episode")
    p.add_argument("--device", default="cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args(argv)
    if args.worlds < 1:
        raise ConfigError(f"--worlds {args.worlds}: at least 1")
    bench, request = Bench(args.device), Request("reference", args.worlds, None, args.steps)
    rows = []
    for checkpoint in args.checkpoints:
        policy = load_policy(checkpoint)
        enough = round(2 * SETTLED / policy.config.env.control_timestep)
        if args.steps < enough:
            raise ConfigError(f"--steps {args.steps}: a gait needs {enough} env steps or more")
        recording = record(bench, policy, request)
        joints = recording.model.jnt_type
        if recording.model.nv < 7 or joints[0] != mujoco.mjtJoint.mjJNT_FREE or recording.model.nq != len(joints) + 6:
            raise ConfigError(f"{checkpoint}: its model is no free root with hinges; ant is")
        whole = [w for w in range(recording.count) if recording.length(w) >= enough]
        if not whole:
            raise ConfigError(
                f"{checkpoint}: all episodes ended within {2 * SETTLED:g} s; name a policy that lasts longer"
            )
        gaits = [gait(recording.world(w), recording.timestep) for w in whole]
        vx, flight, rate = (float(np.median([getattr(g, key) for g in gaits])) for key in ("vx", "flight", "rate"))
        shares, past = (np.mean([getattr(g, key) for g in gaits], axis=0) for key in ("at_end", "past"))
        locked = [
            f"{mujoco.mj_id2name(recording.model, mujoco.mjtObj.mjOBJ_JOINT, j + 1)} {share:.0%}, "
            f"{np.degrees(past[j]):.0f}° past it"
            for j, share in enumerate(shares)
            if share > LOCKED
        ]
        figures = [f"{vx:.2f}", f"{flight:.0%}", f"{rate:.2f}", f"{vx / rate:.2f}", "; ".join(locked) or "none"]
        rows.append([str(checkpoint), *figures, f"{len(whole)} of {recording.count}"])
        print(" | ".join(rows[-1]), flush=True)
    header = [
        "policy",
        "vx, m/s",
        "in the air",
        "strides/s",
        "stride, m",
        "joints at an end of their range",
        "episodes",
    ]
    publish(
        "ant_gaits", "Gaits of ants, medians over episodes", args.device, markdown_table(header, rows), args.results
    )
    return 0


if __name__ == "__main__":
    sys.exit(run(main, sys.argv[1:]))
