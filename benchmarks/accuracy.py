"""Accuracy of gradients: each mode against float64 central differences of C MuJoCo, on the environments' models."""

import argparse
import statistics
from pathlib import Path

from record import RESULTS, markdown_table, publish

from msk_ray.config import load_config
from msk_ray.envs import env_class
from msk_ray.step import Simulation, check_gradients
from msk_ray.step.autograd.modes import configured_backward


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("configs", nargs="+", type=Path, help="trials whose models are checked")
    p.add_argument("--modes", nargs="+", default=["tape_per_substep", "fd_jacobian"])
    p.add_argument("--substeps", type=int, nargs="+", default=[1, 4, 16])
    p.add_argument("--states", nargs="+", default=["standing", "contact"])
    p.add_argument("--worlds", type=int, default=24, help="states of each kind")
    p.add_argument("--solver-tolerance", type=float, help="of Warp's solver; by default the model's own")
    p.add_argument("--device", default="cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    rows = []
    for path in args.configs:
        config = load_config(path)
        model = env_class(config.env).build_model(config.env, config.physics)
        for mode in args.modes:
            for substeps in args.substeps:
                for state in args.states:
                    sim = Simulation(
                        model,
                        args.worlds,
                        substeps,
                        configured_backward(config.physics.model_copy(update={"backward": mode})),
                        args.device,
                        tolerance=args.solver_tolerance,
                    )
                    report = check_gradients(sim, states=(state,))
                    row = [path.stem, mode, str(substeps), state]
                    for name in ("ctrl", "qpos", "qvel"):
                        errors = [r.rel_error for r in report.of(name)]
                        row.append(f"{statistics.median(errors):.0e} / {max(errors):.0e}" if errors else "-")
                    errors = [r.rel_error for r in report.results]
                    row.append(f"{sum(e > 2e-2 for e in errors)} of {len(errors)}")
                    rows.append([*row, f"{report.kinks}", f"{report.forward_mismatches}"])
                    print(rows[-1], flush=True)
    header = ["model", "mode", "substeps", "states", "ctrl", "qpos", "qvel", "past 2e-2", "kinks", "mismatches"]
    title = "Relative error of gradients, median / largest"
    publish("accuracy", title, args.device, markdown_table(header, rows), args.results)


if __name__ == "__main__":
    main()
