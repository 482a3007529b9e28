"""Accuracy of the policy gradient over long rollouts: BPTT against float64 differences of the whole loss."""

import argparse
import statistics
from pathlib import Path

from record import RESULTS, markdown_table, publish

from msk_ray.config import load_config
from msk_ray.envs import env_class
from msk_ray.gradcheck import check_chain, make_states
from msk_ray.simulation.modes import make_backward


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("configs", nargs="+", type=Path, help="trials whose models are checked")
    p.add_argument("--mode", default="tape_per_substep")
    p.add_argument("--horizons", type=int, nargs="+", default=[1, 8, 16, 32], help="env steps")
    p.add_argument("--states", nargs="+", default=["standing", "contact"])
    p.add_argument("--worlds", type=int, default=6, help="starting states of each kind")
    p.add_argument("--device", default="cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    rows = []
    for path in args.configs:
        config = load_config(path)
        model = env_class(config.env).build_model(config.env, config.physics)
        substeps = config.physics.resolve_substeps(config.env.control_timestep)
        for state in args.states:
            points = make_states(model, state, args.worlds, 0)
            results = check_chain(
                model, make_backward(args.mode), points, args.horizons, substeps=substeps, device=args.device
            )
            for horizon in args.horizons:
                own = [r for r in results if r.horizon == horizon]
                error = [r.rel_error for r in own]
                ratio = [r.norm_ratio for r in own]
                rows.append(
                    [
                        path.stem,
                        state,
                        f"{horizon}",
                        f"{statistics.median(error):.0e} / {max(error):.0e}",
                        f"{min(r.cosine for r in own):.4f}",
                        f"{min(ratio):.3f} … {max(ratio):.3f}",
                        f"{statistics.median(r.norm for r in own):.3g}",
                    ]
                )
                print(rows[-1], flush=True)
    header = ["model", "from", "horizon", "rel. error, median / largest", "least cosine", "norm ratio", "median norm"]
    publish(
        "horizon",
        f"Policy gradient over the horizon, {args.mode}",
        args.device,
        markdown_table(header, rows),
        args.results,
    )


if __name__ == "__main__":
    main()
