"""`python -m msk_ray.export`: policies for other programs, and for other people."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from msk_ray.cli import STORAGE, Parser, run
from msk_ray.compiling import announce_compiling
from msk_ray.config.packages import require
from msk_ray.errors import ConfigError
from msk_ray.evaluate.targets import REFERENCE, checkpoint_of, find_target
from msk_ray.export.formats import FORMATS
from msk_ray.files import make_folder
from msk_ray.sweep.space import parse_seeds

DESCRIPTION = """\
Export a policy for programs that do not have msk_ray: as ONNX, as TorchScript, or both.

The network takes raw observations (batch, O), float32, and returns `action` (batch, A) in [-1, 1] and `ctrl` (batch,
nu), the controls of the model; normalisation and squashing are inside. If controls depend on the previous action or on
memories of the environment, or the observation shows memories, these are further inputs, which the call before gives;
if controls depend on the state, there is no `ctrl`. Each file is compared with the checkpoint's policy on 1000
observations, and one with memories over 50 steps; if any output differs by more than 1e-5, nothing is written.

With p.onnx come p.json (order and units of observation and action, memories with their start values, control period,
joints, origin) and p.mjb, the model, for the same version of MuJoCo (mujoco.MjModel.from_binary_path).

--zoo keeps the policy for evaluate, visualize and export: NAME.pt, which cannot be trained further, and NAME.yaml with
its settings, its score over --seeds, the commit, the command and the GPU. It updates the table in the folder's
README.md."""

EXAMPLES = """\
  python -m msk_ray.export runs/demo --onnx policy.onnx                     # the best policy of an experiment
  python -m msk_ray.export runs/train/ant_seed0 --onnx ant.onnx --torchscript ant.pt
  python -m msk_ray.export cartpole --torchscript cartpole.pt               # one of policies/
  python -m msk_ray.export runs/train/ant_seed0 --zoo policies/ant          # for others to use

exit codes: 0 done, 2 refused."""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.export", DESCRIPTION, EXAMPLES)
    p.add_argument(
        "target",
        metavar="CHECKPOINT|TRIAL|EXPERIMENT",
        help="a .pt file, a folder, or a name; its best policy is exported",
    )
    for name, format in FORMATS.items():
        p.add_argument(f"--{name}", type=Path, metavar="FILE", help=format.help)
    p.add_argument(
        "--physics",
        metavar="NAME",
        help="physics of the model: reference (used for scores), own (used in training), or the name of one (default: "
        "reference)",
    )
    p.add_argument("--storage", **STORAGE)
    zoo = p.add_argument_group("a policy for others to use")
    zoo.add_argument("--zoo", type=Path, metavar="FOLDER/NAME", help="write FOLDER/NAME.pt and FOLDER/NAME.yaml")
    zoo.add_argument("--seeds", metavar="LIST", help="seeds of the initial states for its score (default: 0-4)")
    zoo.add_argument("--device", help="cpu or cuda:N, to compute its score (default: the first GPU, or the CPU)")
    zoo.add_argument("--command", metavar="TEXT", help="the command that trained it, if its trial does not record one")
    zoo.add_argument("--commit", metavar="HASH", help="the commit it was trained with")
    zoo.add_argument("--machine", metavar="TEXT", help="the machine it was trained on, such as '1 × NVIDIA H200'")
    zoo.add_argument(
        "--chosen",
        metavar="TEXT",
        help="how the checkpoint was chosen, if it is not a trial's best.pt: 'the newest checkpoint'",
    )
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    checkpoint = checkpoint_of(find_target(args.target, args.storage))
    paths = {name: path for name in FORMATS if (path := getattr(args, name)) is not None}
    if args.zoo is not None:
        return _add_to_zoo(args, checkpoint, bool(paths))
    given = [name for name in _ZOO_OPTIONS if getattr(args, name) is not None]
    if given:
        raise ConfigError(f"--{given[0]}: only --zoo reads it; leave it out")
    _check_paths(paths, checkpoint)
    # torch and Warp take seconds to load; a wrong command line should not wait for them.
    announce_compiling(f"exporting {checkpoint}")
    from msk_ray.export.write import export

    for line in export(checkpoint, paths, args.physics or REFERENCE):
        print(line, flush=True)
    return 0


_ZOO_OPTIONS = ("seeds", "device", "command", "commit", "machine", "chosen")


def _add_to_zoo(args: argparse.Namespace, checkpoint: Path, files: bool) -> int:
    if files or args.physics is not None:
        raise ConfigError("--zoo scores under reference physics and writes no other files: leave the other options out")
    if args.zoo.suffix or args.zoo.name in ("", ".."):
        raise ConfigError(f"--zoo {args.zoo}: write FOLDER/NAME, without a suffix")
    seeds = parse_seeds(args.seeds or "0-4")
    make_folder(args.zoo.parent)
    from msk_ray.evaluate.measure import default_device
    from msk_ray.export.zoo import Origin, add_to_zoo
    from msk_ray.step.autograd.simulation import resolve_device

    device = args.device or default_device()
    resolve_device(device)
    given = Origin(args.command, args.commit, args.machine, args.chosen)
    for line in add_to_zoo(checkpoint, args.zoo, given, seeds, device):
        print(line, flush=True)
    return 0


def _check_paths(paths: dict[str, Path], checkpoint: Path) -> None:
    if not paths:
        options = ", ".join(f"--{name} FILE" for name in FORMATS)
        raise ConfigError(f"nothing to write: give {options} or --zoo FOLDER/NAME")
    for name, path in paths.items():
        format = FORMATS[name]
        if path.suffix != format.suffix:
            raise ConfigError(f"--{name} {path}: write a name that ends in {format.suffix}")
        if path.resolve() == checkpoint:
            raise ConfigError(f"--{name} {path}: this is the checkpoint itself; write another name")
        require(format.packages, f"--{name}")
        make_folder(path.parent)


if __name__ == "__main__":
    sys.exit(run(main))
