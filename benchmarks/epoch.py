"""Where a SHAC epoch's time goes: rollout, backward, critic, for several numbers of worlds."""

import argparse
import statistics
import tempfile
from pathlib import Path

from record import RESULTS, markdown_table, publish

from msk_ray.config import load_config
from msk_ray.training import Trainer


def main() -> None:
    """Run the benchmark the command line asks for."""
    import torch

    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--config", type=Path, default=Path("configs/ant.yaml"))
    p.add_argument("--worlds", type=int, nargs="+", default=[16])
    p.add_argument("--epochs", type=int, default=5, help="timed epochs; two more come before them")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    p.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    rows = []
    for worlds in args.worlds:
        overrides = [
            *args.overrides,
            f"env.nworld={worlds}",
            "evaluation.nworld=1",
            "evaluation.steps=1",
            "evaluation.interval=1000000",
            f"trial.epochs={args.epochs + 100}",
            "trial.checkpoint_interval=1000000",
        ]
        config = load_config(args.config, overrides)
        with tempfile.TemporaryDirectory() as folder:
            trainer = Trainer(config, Path(folder), args.device)
            epochs = [trainer.run_epoch() for _ in range(args.epochs + 2)][2:]
            trainer.close()
        parts = [
            statistics.median(row[f"time/{part}_s"] for row in epochs) for part in ("rollout", "backward", "critic")
        ]
        steps = epochs[0]["train/horizon"] * worlds
        total = sum(parts)
        rows.append(
            [f"{worlds}", f"{steps:.0f}", *(f"{1e3 * part:.1f}" for part in (*parts, total)), f"{steps / total:,.0f}"]
        )
        print(rows[-1], flush=True)
    title = f"SHAC epoch, {config.env.name}, {config.physics.backward}"
    header = ["worlds", "env steps", "rollout ms", "backward ms", "critic ms", "epoch ms", "env steps/s"]
    publish("epoch", title, args.device, markdown_table(header, rows), args.results)


if __name__ == "__main__":
    main()
