"""`python -m msk_ray.diagnose`: how good are the gradients in the states that a policy visits?"""

import argparse
import json
import statistics
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from msk_ray.cli import Parser, positive, run
from msk_ray.compiling import announce_compiling
from msk_ray.config import SET_HELP
from msk_ray.errors import CheckpointError, ConfigError
from msk_ray.files import make_folder, write_text
from msk_ray.progress import Pace

if TYPE_CHECKING:
    from msk_ray.diagnose.probe import Quality

DESCRIPTION = """\
Compare the policy gradient of the environment's reward with float64 central differences of C MuJoCo, over several
horizons, from states that the policy visits, under several physics.

cosine      1: both gradients have the same direction; below about 0.9 the horizon is too long for this physics
norm ratio  1: both have the same length; far above 1, products of Jacobians explode
cotangent   norm of the gradient to the starting state [reward], which shac.state_grad_clip bounds

Give a config to use a new policy, or a checkpoint to use its policy. Writes table.md, rows.json and quality.png."""

EXAMPLES = """\
  python -m msk_ray.diagnose configs/ant.yaml --variants matched published
  python -m msk_ray.diagnose runs/train/ant_seed0/checkpoints/best.pt --states standing gait --horizons 1 8 32"""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.diagnose", DESCRIPTION, EXAMPLES)
    p.add_argument("subject", type=Path, metavar="CHECKPOINT_OR_CONFIG", help="a .pt file, or a config's .yaml file")
    p.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help=f"for a config: {SET_HELP}"
    )
    p.add_argument("--variants", nargs="+", metavar="NAME", help="named physics (default: all of the environment's)")
    p.add_argument(
        "--states",
        nargs="+",
        choices=("reset", "standing", "gait"),
        help="where trajectories start (default: all possible ones)",
    )
    p.add_argument(
        "--horizons",
        nargs="+",
        type=positive,
        default=[1, 4, 8, 16, 32],
        metavar="H",
        help="lengths of trajectories, in env steps (default: 1 4 8 16 32)",
    )
    p.add_argument(
        "--worlds", type=positive, default=4, metavar="W", help="starting states of each kind (default: %(default)s)"
    )
    p.add_argument(
        "--directions",
        type=positive,
        default=16,
        metavar="N",
        help="random directions in the space of the policy's weights (default: %(default)s)",
    )
    p.add_argument("--seed", type=int, default=0, help="seed of states and directions (default: %(default)s)")
    p.add_argument("--device", default="cpu", help="cpu or cuda:N (default: %(default)s)")
    p.add_argument("--output", type=Path, metavar="DIR", help="folder to write to (default: runs/diagnose/NAME)")
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    _check(args)
    announce_compiling(
        f"comparing policy gradients of {args.subject} with float64 differences on {args.device}: {args.worlds} worlds "
        f"of each kind of state, horizons {', '.join(map(str, args.horizons))}, {args.directions} directions"
    )

    # torch and Warp take seconds to load; a wrong command line should not wait for them.
    from msk_ray.diagnose.probe import probe, read_subject
    from msk_ray.step.autograd.simulation import resolve_device

    subject = read_subject(args.subject, args.overrides)
    known = subject.config.env.variants
    for name in args.variants or ():
        if name not in known:
            raise ConfigError(
                f"env {subject.config.env.name} has no physics named {name!r}; "
                + (f"write {', '.join(known)}" if known else "leave out --variants")
            )
    resolve_device(args.device)
    states = args.states or (("reset", "standing") if subject.saved is None else ("reset", "standing", "gait"))
    name = args.subject.stem if subject.saved is None else f"{args.subject.parent.parent.name}_{args.subject.stem}"
    output = args.output or Path("runs") / "diagnose" / name
    make_folder(output)

    rows: list[Quality] = []
    print(f"{'physics':24}{'from':10}{'horizon':>8}{'cosine: median, least':>24}{'norm ratio':>20}{'cotangent':>12}")
    chosen: Sequence[str | None] = args.variants or known or (None,)
    pace = Pace("comparisons", len(chosen) * len(states) * len(args.horizons) * args.worlds)
    comparisons = probe(
        subject,
        chosen,
        states,
        args.horizons,
        worlds=args.worlds,
        directions=args.directions,
        seed=args.seed,
        device=args.device,
    )
    for row in comparisons:
        rows.append(row)
        pace(len(rows))
        if len(rows) % args.worlds == 0:
            print("".join(_cells(rows[-args.worlds :])), flush=True)
    _write(rows, args.worlds, output)
    return 0


def _check(args: argparse.Namespace) -> None:
    """Check the arguments before torch and Warp are loaded."""
    if args.seed < 0:
        raise ConfigError(f"--seed must not be negative, not {args.seed}")
    if args.subject.suffix == ".pt" and not args.subject.is_file():
        raise CheckpointError(f"no checkpoint {args.subject}")


def _write(rows: "Sequence[Quality]", worlds: int, output: Path) -> None:
    """Write the results as a table, JSON and a picture, and print where."""
    from msk_ray.diagnose.picture import draw

    header = ["physics", "from", "horizon", "cosine: median, least", "norm ratio", "cotangent"]
    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    for i in range(0, len(rows), worlds):
        lines.append("| " + " | ".join(cell.strip() for cell in _cells(rows[i : i + worlds])) + " |")
    write_text(output / "table.md", "\n".join(lines) + "\n")
    write_text(output / "rows.json", json.dumps([asdict(row) for row in rows], indent=1))
    draw(rows, output / "quality.png")
    print(f"written: {output / 'table.md'}, {output / 'rows.json'}, {output / 'quality.png'}")


def _cells(group: "Sequence[Quality]") -> list[str]:
    """One line of the table: the worlds of one physics, state and horizon."""
    first = group[0]
    ratio = [row.norm_ratio for row in group]
    cosine = [row.cosine for row in group]
    return [
        f"{first.variant:24}",
        f"{first.state:10}",
        f"{first.horizon:>8}",
        f"{statistics.median(cosine):>14.4f}, {min(cosine):>8.4f}",
        f"{min(ratio):>9.3g} … {max(ratio):<8.3g}",
        f"{statistics.median(row.cotangent for row in group):>12.3g}",
    ]


if __name__ == "__main__":
    sys.exit(run(main))
