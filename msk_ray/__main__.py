"""`python -m msk_ray VERB` and the console script `msk-ray VERB`: every command under one name."""

import sys
from collections.abc import Sequence
from importlib import import_module

import msk_ray
from msk_ray import signals
from msk_ray.cli import run

COMMANDS = {
    "train": ("msk_ray.train", "train one policy in this process, without Ray"),
    "tune": ("msk_ray.tune.__main__", "run a search space as a Ray Tune experiment"),
    "evaluate": ("msk_ray.evaluate.__main__", "evaluate policies: fixed seeds, no noise, every reward term"),
    "visualize": ("msk_ray.visualize.__main__", "watch a policy: viewer, video, frames, film strip"),
    "export": ("msk_ray.export.__main__", "write a policy as ONNX or TorchScript, with its model and description"),
    "gait": ("msk_ray.legs.gait.__main__", "measure how a leg policy walks, compared with people"),
    "report": ("msk_ray.report.__main__", "write an experiment's report: curves, tables, the best policy"),
    "dashboard": ("msk_ray.dashboard.__main__", "serve the experiments as live pages in a browser"),
    "status": ("msk_ray.status", "show the progress of experiments, read from their files"),
    "doctor": ("msk_ray.doctor", "check that this machine can run trials, and say what to fix"),
    "diagnose": ("msk_ray.diagnose.__main__", "compare a policy's gradients with float64 differences, by horizon"),
    "gradcheck": ("msk_ray.gradcheck", "check a model's gradients against float64 finite differences"),
}

SAVING = ("train", "tune")
"""The commands that save their state when they are asked to stop."""


def usage() -> str:
    """The list of commands."""
    lines = [f"  {name:10} {text}" for name, (_, text) in COMMANDS.items()]
    return "usage: msk-ray COMMAND [options]\n\n" + "\n".join(lines) + "\n\nRun msk-ray COMMAND --help for details."


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command by name; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0
    if arguments == ["--version"]:
        print(f"msk_ray {msk_ray.__version__}")
        return 0
    name, *rest = arguments
    if name not in COMMANDS:
        print(f"error: no command {name!r}; write one of {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    if name in SAVING:
        # Before the imports that take time to load.
        signals.listen()
    return run(import_module(COMMANDS[name][0]).main, rest)


if __name__ == "__main__":
    sys.exit(main())
