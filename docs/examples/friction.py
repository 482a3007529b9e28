"""Train a policy that is robust to friction, beside one that is not, and score both over the range.

    python docs/examples/friction.py friction.png

The task is that of tray.py: a tray has to be in the middle soon, and the puck on it must not slip. At the friction of
the model, 0.8, it can accelerate twice as much as at 0.4. A policy that only ever met 0.8 makes use of it; one that met
0.4 to 1.2 in training, another value in every episode, does not.
"""

import argparse
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import msk_ray
from msk_ray.config import RandomizeConfig
from msk_ray.training import Evaluator, read_metrics

HERE = Path(__file__).parent
LOW, HIGH = 0.4, 1.2
VARIANTS = {
    "friction 0.8, as in the model": [],
    "friction 0.4 to 1.2, drawn for every episode": [
        f"physics.randomize={{geom_friction: {{low: {LOW}, high: {HIGH}, mode: value, distribution: log_uniform}}}}"
    ],
}


def scores(checkpoint: Path, frictions: list[float]) -> list[float]:
    """Mean score of a policy under each friction."""
    policy = msk_ray.load_policy(checkpoint)
    found = []
    for friction in frictions:
        value = {"low": friction, "high": friction, "mode": "value"}
        evaluator = Evaluator(policy.config, "cpu", varied=RandomizeConfig.model_validate({"geom_friction": value}))
        found.append(float(evaluator.episodes(policy.on(evaluator.env)).score.mean()))
    return found


def main() -> None:
    """Train, score and draw."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("picture", nargs="?", default="friction.png")
    p.add_argument("--epochs", type=int, default=120)
    p.add_argument("--values", type=int, default=9, help="frictions at which policies are scored")
    args = p.parse_args()
    frictions = [LOW + (HIGH - LOW) * k / (args.values - 1) for k in range(args.values)]
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4))
    for name, changes in VARIANTS.items():
        config = msk_ray.load_config(HERE / "tray.yaml", [*changes, f"trial.epochs={args.epochs}"])
        with tempfile.TemporaryDirectory() as folder:
            trained = msk_ray.train(config, folder, "cpu")
            rows = [row for row in read_metrics(Path(folder) / "metrics.jsonl") if "eval/score" in row]
            # Not best.pt, which is the best one at the model's own friction.
            found = scores(max((trained.logdir / "checkpoints").glob("epoch_*.pt")), frictions)
        print(f"{name}: worst score {min(found):.1f}, at 0.8 {found[len(found) // 2]:.1f}", flush=True)
        left.plot([row["env_steps"] for row in rows], [row["eval/score"] for row in rows], "-o", label=name)
        right.plot(frictions, found, "-o", label=name)
    left.set(xlabel="env steps", ylabel="score at friction 0.8", title="while training")
    right.set(xlabel="friction", ylabel="score", title="the last policy of each")
    right.legend(title="trained with", fontsize=8)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.savefig(args.picture, dpi=110, bbox_inches="tight")
    print(f"drawn in {args.picture}")


if __name__ == "__main__":
    main()
