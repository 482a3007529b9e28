"""An ant's env step with its gradient, and an epoch of SHAC, here and by other differentiable simulators.

    python benchmarks/peers/peers.py --pr1535 CHECKOUT --pr1423 CHECKOUT --site FOLDER --worlds 64 1024 4096

The others are branches of mujoco_warp that were proposed to it, google-deepmind/mujoco_warp pull requests 1535 (head
02d09b1) and 1423 (head eeac6f2). They need an older mujoco: FOLDER has one, made by
`pip install --no-deps --target FOLDER mujoco==3.10.0`. Each simulator is measured in a process of its own, all of them
in turn. All step the model of configs/ant.yaml, from the same states of ants in contact, and run the same epoch,
operation by operation; `msk_ray.train` records its own (benchmarks/epoch.py).

`state apart` is the largest difference of the states after an env step from ours, relative to their largest entry.
`gradients` is the cosine of the gradients of all worlds with ours.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from record import RESULTS, markdown_table, publish

from msk_ray.config import load_config
from msk_ray.envs.ant.model import ant_spec

HERE = Path(__file__).parent
STATES = 64
"""Different states that the worlds start from."""


def write_scene(folder: Path) -> int:
    """Write ant.xml and states of ants in contact there, and return the substeps of an env step."""
    config = load_config(Path("configs/ant.yaml"))
    spec = ant_spec(config.env, config.physics)
    model = spec.compile()
    (folder / "ant.xml").write_text(spec.to_xml())
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    found: dict[str, list[Any]] = {"qpos": [], "qvel": []}
    for _ in range(STATES):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qvel[:] = 0.3 * rng.normal(size=model.nv)
        for _ in range(240):
            data.ctrl[:] = 0.3 * rng.uniform(-1.0, 1.0, model.nu)
            mujoco.mj_step(model, data)
        for name, values in found.items():
            values.append(getattr(data, name).copy())
    np.savez(folder / "states.npz", **{name: np.array(values) for name, values in found.items()})
    return round(config.env.control_timestep / model.opt.timestep)


def measured(peer: str, path: list[Path], options: list[str]) -> dict[str, Any] | str:
    """A worker's figures, or why there are none."""
    found = [str(p.resolve()) for p in path]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([*found, os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, str(HERE / "worker.py"), peer, *options]
    run = subprocess.run(command, env=env, capture_output=True, text=True)
    if run.returncode:
        return run.stderr.strip().splitlines()[-1]
    result: dict[str, Any] = json.loads(run.stdout.strip().splitlines()[-1])
    return result


def row(worlds: int, peer: str, found: dict[str, Any] | str, ours: dict[str, Any]) -> list[str]:
    """A line of the table."""
    if isinstance(found, str):
        return [f"{worlds}", peer, f"failed: {found}"[:100], "-", "-", "-"]
    apart = max(
        np.abs(np.subtract(a, b)).max() / np.abs(b).max() for a, b in zip(found["end"], ours["end"], strict=True)
    )
    a, b = (np.concatenate(of["grad"]) for of in (found, ours))
    cosine = float(a @ b / np.sqrt((a @ a) * (b @ b)))
    return [f"{worlds}", peer, f"{found['step']:.2f}", f"{found['epoch']:.1f}", f"{apart:.1e}", f"{cosine:.4f}"]


def main() -> None:
    """Run the benchmark the command line asks for."""
    import torch

    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--worlds", type=int, nargs="+", default=[16])
    p.add_argument("--pr1535", type=Path, help="checkout of the branch; left out without one")
    p.add_argument("--pr1423", type=Path, help="checkout of the branch; left out without one")
    p.add_argument("--site", type=Path, default=Path(), help="folder with the branches' mujoco")
    p.add_argument("--horizon", type=int, default=8)
    p.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    peers = {"ours": [Path()]}
    peers |= {n: [getattr(args, n), args.site] for n in ("pr1535", "pr1423") if getattr(args, n) is not None}
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        substeps = write_scene(Path(folder))
        for worlds in args.worlds:
            options = [f"--xml={folder}/ant.xml", f"--states={folder}/states.npz", f"--worlds={worlds}"]
            options += [f"--substeps={substeps}", f"--horizon={args.horizon}", f"--device={args.device}"]
            found = {peer: measured(peer, path, options) for peer, path in peers.items()}
            ours = found["ours"]
            if isinstance(ours, str):
                raise SystemExit(ours)
            rows += [row(worlds, peer, figures, ours) for peer, figures in found.items()]
            print(*rows[-len(peers) :], sep="\n", flush=True)
    header = ["worlds", "simulator", "env step, forward + backward ms", "epoch ms", "state apart", "gradients"]
    publish(
        "peers",
        f"Ant by several simulators, horizon {args.horizon}",
        args.device,
        markdown_table(header, rows),
        args.results,
    )


if __name__ == "__main__":
    main()
