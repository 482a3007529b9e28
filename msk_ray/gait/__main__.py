"""`python -m msk_ray.gait`: how does a policy walk, compared with people?"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msk_ray.cli import Parser, run
from msk_ray.evaluate.__main__ import positive
from msk_ray.evaluate.targets import best_checkpoint, find_target, trial_folder_of
from msk_ray.files import write_json
from msk_ray.text_table import text_table

DESCRIPTION = """\
Measure the gait of a policy of a leg environment (myoleg26, myoleg): speed, cadence, step length, duty factor, joint
angles and ground reaction over the gait cycle, symmetry, cost and falls, compared with the range of healthy adults.

Episodes are those of the evaluation: without noise or assistance, from fixed initial states. Their first second is
left out. Writes gait.json and gait.png into the trial's folder or that of --out."""

EXAMPLES = """\
  python -m msk_ray.gait runs/train/myoleg26_seed0
  python -m msk_ray.gait myoleg26_reward --worlds 64 --out gait/          # the best trial of an experiment"""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.gait", DESCRIPTION, EXAMPLES)
    p.add_argument(
        "target", metavar="CHECKPOINT|TRIAL|EXPERIMENT", help="the policy to measure: itself, or the best one"
    )
    p.add_argument("--worlds", type=positive, default=16, metavar="W", help="episodes (default: %(default)s)")
    p.add_argument("--steps", type=positive, metavar="N", help="maximum env steps per episode")
    p.add_argument("--out", type=Path, metavar="DIR", help="folder to write to (default: the trial's)")
    p.add_argument("--device", help="cpu or cuda:N (default: the first GPU, or the CPU if there is none)")
    p.add_argument(
        "--storage", type=Path, default=Path("runs"), metavar="DIR", help="folder of experiments (default: runs/)"
    )
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    path = best_checkpoint(find_target(args.target, args.storage))

    from msk_ray.envs.legs.gait.body import analyse, check_legs
    from msk_ray.envs.legs.gait.measure import measure
    from msk_ray.evaluate.measure import Bench, Request, default_device
    from msk_ray.gait.picture import draw
    from msk_ray.training import load_policy
    from msk_ray.visualize.episodes import record

    policy = load_policy(path)
    bench = Bench(args.device or default_device())
    request = Request(worlds=args.worlds, steps=args.steps)
    check_legs(bench.evaluator(policy.config, request)[0].env.model)
    recording = record(bench, policy, request)
    episodes = []
    for world in range(recording.count):
        states = recording.world(world)
        episodes.append(analyse(recording.model, states.qpos, states.qvel, states.act, recording.timestep))
    gait = measure(episodes, recording.episodes.fell.tolist())
    out = args.out or trial_folder_of(path)
    out.mkdir(parents=True, exist_ok=True)
    entry = {"checkpoint": path.name, "epoch": policy.epoch, "physics": recording.physics, **gait}
    write_json(out / "gait.json", entry)
    draw(gait, f"{path.name}, epoch {policy.epoch}", out / "gait.png")
    print(gait_text(gait))
    print(f"written into {out / 'gait.json'} and {out / 'gait.png'}")
    return 0


def gait_text(gait: dict[str, Any]) -> str:
    """Measures and landmarks for a terminal."""
    rows = []
    for name, entry in (*gait["measures"].items(), *gait["landmarks"].items()):
        value = "-" if entry["value"] is None else f"{entry['value']:.4g}"
        within = {None: "-", True: "yes", False: "no"}[entry["within"]]
        rows.append((name, value, "{:g} to {:g}".format(*entry["human"]), entry["unit"], within))
    for name, value in gait["costs"].items():
        rows.append((name, "-" if value is None else f"{value:.4g}", "", "", ""))
    falls = "-" if gait["falls"] is None else f"{gait['falls']:.0%}"
    return (
        text_table(("measure", "policy", "people", "unit", "within"), rows, 120)
        + f"\n{gait['strides']} strides in {gait['episodes']} episodes, {falls} of which ended in a fall"
    )


if __name__ == "__main__":
    sys.exit(run(main))
