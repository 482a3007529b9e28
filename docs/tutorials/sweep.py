# %% [markdown]
# # Train, sweep, and read a report
#
# One training run says little: another learning rate or another seed may end elsewhere. This notebook trains CartPole
# once, then compares learning rates in a sweep, and reads what the sweep says. On two CPU cores it takes about ten
# minutes; on GPUs the same commands run one trial on each.

# %%
import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import msk_ray

# %% tags=["parameters"]
SMALL = ["trial.epochs=40", "evaluation.interval=10"]
SPACE = """
question: Which learning rate suits CartPole?
base: configs/cartpole.yaml
overrides: {trial.epochs: 40, evaluation.interval: 10}
parameters:
  shac.actor_lr: {grid: [5.0e-4, 5.0e-3, 5.0e-2]}
seeds: 0-1
"""
RUNS = Path("runs")

# %% [markdown]
# ## One trial
#
# A config has every setting of a trial. `cartpole` is one of those that come with the package; settings by name
# change it. The pole hangs down at first. The score of an episode is minus the sum of penalties on its angle, speed
# and the cart's position, so it is below zero; −550 is a pole that is swung up and held. The 40 epochs here are too
# few for that, and enough to compare settings.

# %%
config = msk_ray.load_config("cartpole", SMALL)
rows = []
trained = msk_ray.train(config, RUNS / "first", "cpu", on_epoch=rows.append)
scores = [(row["epoch"], row["eval/score"]) for row in rows if "eval/score" in row]
print(f"best score {trained.best_score:.0f} after {trained.epochs} epochs: {trained.best_checkpoint.name}")

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
left.plot(*zip(*scores, strict=True), "o-")
left.set(xlabel="epoch", ylabel="score", title="evaluation, without noise")
right.semilogy([row["epoch"] for row in rows], [row["grad/actor_norm"] for row in rows])
right.set(xlabel="epoch", title="norm of the policy's gradient")
plt.show()

# %% [markdown]
# Every epoch is a row in `metrics.jsonl`: rewards, gradient norms, seconds. The best policy by evaluation is kept. It
# is a function of the observation and needs no simulator:

# %%
policy = msk_ray.load_policy(trained.best_checkpoint)
# Position and velocity of the cart, sine and cosine of the pole's angle (0: upright), and its velocity.
moving = np.array([[0.0, 0.0, 0.0, -1.0, velocity] for velocity in (-2.0, 0.0, 2.0)], dtype=np.float32)
print("force where the pole hangs and swings left, not at all, right:", policy(moving)[:, 0].round(2))

# %% [markdown]
# ## A sweep
#
# A space file says what varies. `grid` tries each value, `seeds` repeats every trial with other random numbers. Look
# first at what would run:

# %%
Path("rates.yaml").write_text(SPACE)


def msk(*words: object) -> str:
    """Run a command of msk_ray; what it printed."""
    command = [sys.executable, "-m", "msk_ray", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    return done.stdout


print(msk("tune", "--space", "rates.yaml", "--storage", RUNS, "--dry-run"))

# %% [markdown]
# Then run it. In a terminal, `msk-ray tune --space rates.yaml` shows the trials while they run, Ctrl-C saves them,
# and `--resume` continues. Here we wait until it has ended.

# %%
if not (RUNS / "rates").exists():
    msk("tune", "--space", "rates.yaml", "--storage", RUNS, "--name", "rates")
print((RUNS / "rates" / "table.md").read_text())

# %% [markdown]
# ## What the report says
#
# The sweep ends with a report, `runs/rates/report/index.html`. It is made from files that you can read too:
# `summary.json` has the result of every trial, and each trial's folder its rows.

# %%
summary = json.loads((RUNS / "rates" / "summary.json").read_text())
print(sorted(path.name for path in (RUNS / "rates" / "report").iterdir()))

figure, axes = plt.subplots(figsize=(6, 3.4), layout="constrained")
colours: dict[float, str] = {}
for trial in summary["trials"]:
    lines = (RUNS / "rates" / trial["folder"] / "metrics.jsonl").read_text().splitlines()
    curve = [(row["env_steps"], row["eval/score"]) for row in map(json.loads, lines) if "eval/score" in row]
    rate = trial["values"]["shac.actor_lr"]
    label = None if rate in colours else f"rate {rate:g}"
    axes.plot(*zip(*curve, strict=True), color=colours.setdefault(rate, f"C{len(colours)}"), label=label)
axes.set(xlabel="env steps", ylabel="score")
axes.legend(fontsize=8)
plt.show()

# %% [markdown]
# How to read it:
#
# - **Curves first.** A rate that is too small is still rising at the end; one that is too large is thrown back. Two
#   seeds of one rate that lie further apart than two rates say that the rate does not decide.
# - **Then variants.** Each has an interval. If intervals overlap, more seeds are needed, not another explanation.
#   With fewer than ten seeds the intervals are too narrow anyway.
# - **Then failures.** A trial that ended as `nonfinite` or `diverged` is named with its reason; it is not left out of
#   the table.
# - **Then stops.** Trials that were stopped early look worse than they are; the report compares them where they
#   stopped.
#
# [Reports](../runner/report.md) describes every part, [spaces](../runner/tune.md) what else a sweep can vary, and how
# it is stopped and resumed.
