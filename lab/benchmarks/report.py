"""How long status and report of a large generated experiment take, and how large its page is."""

import argparse
import json
import math
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from record import RESULTS, markdown_table, publish

from msk_ray.config import dump_yaml
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.outcomes import Ending, Outcome, write_ending
from msk_ray.sweep import opening
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import resolve_trials

TERMS = ("forward_vel", "up", "heading", "height", "action")


def generate(folder: Path, trials: int, epochs: int) -> Experiment:
    """An experiment of the ant as a sweep leaves it: five sampled parameters, two of every twenty trials failed."""
    data: dict[str, Any] = {
        "question": "How does the report scale?",
        "base": "configs/ant.yaml",
        "overrides": {"trial.epochs": epochs, "env.nworld": 64},
        "parameters": {
            "shac.actor_lr": {"loguniform": [1e-4, 1e-2]},
            "shac.critic_lr": {"loguniform": [1e-4, 1e-2]},
            "shac.gamma": {"uniform": [0.95, 0.999]},
            "shac.horizon": {"choice": [8, 16, 32]},
            "shac.state_grad_clip": {"choice": [10.0, 30.0, 100.0]},
        },
        "samples": trials,
        "scheduler": {"kind": "asha", "grace": 0.1},
    }
    space = parse_space(data, folder / "generated.yaml")
    (folder / "generated.yaml").write_text(dump_yaml(data))
    resolved = resolve_trials(space)
    made = opening.create(folder / "runs" / "generated", space, resolved, {})
    for trial in resolved:
        rng = random.Random(trial.index)
        own = made.trial_folder(trial.id)
        own.mkdir(parents=True)
        failed = trial.index % 20 in (3, 7)
        done = epochs // 2 if failed else epochs
        with (own / "metrics.jsonl").open("w") as file:
            file.writelines(json.dumps(row(epoch, rng)) + "\n" for epoch in range(done + 1))
        outcome = Outcome.NONFINITE if failed else Outcome.FINISHED
        write_ending(own, Ending(outcome, "made up for the benchmark"))
    return made


def row(epoch: int, rng: random.Random) -> dict[str, Any]:
    """As many figures an epoch as a trial of the ant writes; an evaluation every tenth."""
    noise = rng.gauss
    score = 4000 * (1 - math.exp(-epoch / 500)) + noise(0, 200)
    found: dict[str, Any] = {
        "epoch": epoch,
        "env_steps": 2048 * epoch,
        "seconds": 0.5 * epoch,
        "env_steps_per_s": 4e5 + noise(0, 1e4),
        **{
            f"train/{name}": noise(1, 0.3)
            for name in ("actor_loss", "critic_loss", "reward", "value", "std", "horizon")
        },
        **{f"train/{name}": noise(500, 30) for name in ("episode_return", "episode_length", "episodes", "actor_lr")},
        "train/diverged": 0.0,
        "grad/actor_norm": math.exp(noise(0, 1)),
        **{f"grad/state_{name}": math.exp(noise(2, 1)) for name in ("median", "p90", "max")},
        "grad/clipped_share": rng.random() * 0.4,
        "grad/nonfinite_share": 0.0 if rng.random() < 0.99 else 0.01,
        **{f"time/{name}_s": noise(0.1, 0.01) for name in ("rollout", "backward", "critic")},
        "physics/solver_limit_share": rng.random() * 0.01,
    }
    if epoch % 10 == 0:
        found |= {"eval/score": score, "eval/score_std": 50.0, "eval/length": 900.0, "eval/best_score": score}
        found |= {"eval/fall_rate": 0.1, "eval/diverged_rate": 0.0, "eval/vx": score / 1500, "time/evaluation_s": 0.4}
        found |= {f"eval/term/{name}": noise(500, 10) for name in TERMS}
    return found


def timed(module: str, *arguments: str) -> tuple[float, float]:
    """Seconds that a command takes, and of them on a CPU."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run([sys.executable, "-m", module, *arguments], check=True, stdout=subprocess.DEVNULL)
    wall, after = time.monotonic() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--trials", type=int, nargs="+", default=[20, 200])
    p.add_argument("--epochs", type=int, default=2000)
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    rows = []
    for trials in args.trials:
        with tempfile.TemporaryDirectory() as scratch:
            experiment = generate(Path(scratch), trials, args.epochs)
            read = sum(path.stat().st_size for path in experiment.path.rglob("metrics.jsonl"))
            load = os.getloadavg()[0]
            status = [f"{seconds:.1f}" for seconds in timed("msk_ray.status", str(experiment.path))]
            wall, cpu = timed("msk_ray.report", str(experiment.path), "--best", "never")
            memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
            page = experiment.path / "report" / "index.html"
            figures = [f"{read / 1e6:.0f}", f"{wall:.1f}", f"{cpu:.1f}", f"{memory / 1024:.0f}"]
            rows.append(
                [f"{trials}", f"{args.epochs}", *status, *figures, f"{page.stat().st_size / 1e6:.2f}", f"{load:.1f}"]
            )
            print(rows[-1], flush=True)
    header = [
        "trials",
        "rows each",
        "status, s",
        "its CPU, s",
        "metrics, MB",
        "report, s",
        "its CPU, s",
        "peak memory, MB",
        "page, MB",
        "load before",
    ]
    publish("report", "Report of a generated experiment", "cpu", markdown_table(header, rows), args.results)


if __name__ == "__main__":
    main()
