"""`python -m msk_ray VERB` and the console script `msk-ray VERB`: every command under one name."""

import sys
from collections.abc import Sequence
from importlib import import_module

import msk_ray
from msk_ray import signals
from msk_ray.cli import Command, run
from msk_ray.registry import Registry, resolve

COMMANDS = {
    "list": Command("msk_ray.tasks", "list the tasks that can be trained, with their configs and scores"),
    "train": Command("msk_ray.train", "train one policy in this process, without Ray"),
    "tune": Command("msk_ray.tune.__main__", "run a search space as a Ray Tune experiment"),
    "evaluate": Command("msk_ray.evaluate.__main__", "evaluate policies: fixed seeds, no noise, every reward term"),
    "play": Command("msk_ray.play.__main__", "watch a task in a viewer: its policy, zero or random actions"),
    "visualize": Command("msk_ray.visualize.__main__", "draw a policy: video, frames, film strip"),
    "export": Command(
        "msk_ray.export.__main__", "write a policy as ONNX or TorchScript, with its model and description"
    ),
    "report": Command("msk_ray.report.__main__", "write an experiment's report: curves, tables, the best policy"),
    "dashboard": Command("msk_ray.dashboard.__main__", "serve the experiments as live pages in a browser"),
    "status": Command("msk_ray.status", "show the progress of experiments, read from their files"),
    "doctor": Command("msk_ray.doctor", "check that this machine can run trials, and what to fix"),
    "diagnose": Command(
        "msk_ray.diagnose.__main__", "compare a policy's gradients with float64 differences, by horizon"
    ),
    "gradcheck": Command("msk_ray.gradcheck", "check a model's gradients against float64 finite differences"),
}

PLUGINS = Registry("msk-ray", "msk_ray.commands", {})
"""Commands declared by packages, such as the legs, by name."""

SAVING = ("train", "tune")
"""Commands that save their state when asked to stop."""


def commands() -> dict[str, Command]:
    """Every command by name: the runner's, then those of installed packages."""
    declared = {name: resolve(PLUGINS.path(name), "msk-ray") for name in PLUGINS.known() if name not in COMMANDS}
    return {**COMMANDS, **declared}


def usage() -> str:
    """The list of commands."""
    lines = [f"  {name:10} {command.summary}" for name, command in commands().items()]
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
    if name in SAVING:
        # Set up before the slow imports.
        signals.listen()
    command = COMMANDS.get(name) or commands().get(name)
    if command is None:
        print(f"error: no command {name!r}; write one of {', '.join(commands())}", file=sys.stderr)
        return 2
    return run(import_module(command.module).main, rest)


if __name__ == "__main__":
    sys.exit(main())
