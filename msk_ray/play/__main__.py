"""`python -m msk_ray.play`: a task in a viewer."""

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from msk_ray.cli import STORAGE, Parser, geom_group_list, port_number, positive, run
from msk_ray.compiling import announce_compiling
from msk_ray.config import ENVIRONMENTS, Config, load_config, parse_config
from msk_ray.errors import ConfigError, DeviceError
from msk_ray.evaluate.targets import REFERENCE, checkpoint_of, find_target
from msk_ray.play import NO_DISPLAY
from msk_ray.shipped import POLICIES, find_shipped, shipped_names
from msk_ray.sweep.space import parse_seeds
from msk_ray.tasks import Task, find_task

if TYPE_CHECKING:
    import mujoco

    from msk_ray.play.screen import Screen

DESCRIPTION = """\
Watch a task, one episode after the other, in MuJoCo's viewer, or with --browser on a page that only this machine can
reach. To see the page from another machine, run ssh -L 8080:127.0.0.1:8080 HOST there.

msk-ray list names the tasks. Episodes are as in evaluation: without noise, and under reference physics unless --physics
says otherwise. Arrows are contact forces (in the browser, switch them on); muscles are blue when relaxed and red when
active. To make films and pictures, use msk-ray visualize."""

EXAMPLES = """\
  python -m msk_ray.play ant                             # its best policy in policies/
  python -m msk_ray.play go1_velocity_robust             # a policy in policies/ by its name
  python -m msk_ray.play go1_velocity --agent zero       # what does the model do by itself?
  python -m msk_ray.play my_robot:Robot --agent random   # a class of yours
  python -m msk_ray.play --agent runs/demo --browser     # the best policy of an experiment"""

ZOO, ZERO, RANDOM = "zoo", "zero", "random"
_PORT = 8080


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.play", DESCRIPTION, EXAMPLES)
    p.add_argument(
        "task",
        nargs="?",
        metavar="TASK",
        help="a task, or the name of a policy in policies/ (default: the task of the policy that --agent names)",
    )
    p.add_argument(
        "--agent",
        default=ZOO,
        metavar="zoo|zero|random|POLICY",
        help="who acts: the task's best policy in policies/ (default), action 0, random actions, or a policy: a "
        "checkpoint, a trial, an experiment, or a name in policies/",
    )
    p.add_argument("--browser", action="store_true", help="show a page in a browser (pip install 'msk-ray[browser]')")
    p.add_argument(
        "--port", type=port_number, metavar="N", help=f"port of the page (default: {_PORT}; 0: any free one)"
    )
    p.add_argument(
        "--episodes", type=positive, metavar="N", help="number of episodes (default: until the window is closed)"
    )
    p.add_argument("--steps", type=positive, metavar="N", help="maximum env steps per episode")
    p.add_argument(
        "--seed", type=int, metavar="N", help="seed of the initial states (default: the seed of evaluations)"
    )
    p.add_argument(
        "--physics",
        default=REFERENCE,
        metavar="NAME",
        help="reference (used for scores), own (used in training), or a name from the environment (default: reference)",
    )
    p.add_argument(
        "--speed", type=float, default=1.0, metavar="X", help="simulated seconds per second (default: 1, real time)"
    )
    p.add_argument(
        "--geom-groups",
        type=geom_group_list,
        metavar="LIST",
        help="groups of geoms to draw, such as 0,3 (default: 0,1,2, and the robot's own if it has no geom in these)",
    )
    p.add_argument("--device", help="cpu or cuda:N, to simulate (default: the first GPU, or the CPU)")
    p.add_argument("--storage", **STORAGE)
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    _take_policy(args)
    _check(args)
    task = None if args.task is None else find_task(args.task)
    checkpoint = _checkpoint(args, task)
    announce_compiling(f"playing {checkpoint or f'{args.task} with {args.agent} actions'}")
    from msk_ray.evaluate.measure import Bench, Request, default_device
    from msk_ray.play.agents import random_policy, zero_policy
    from msk_ray.play.live import play_episodes
    from msk_ray.step.autograd.simulation import resolve_device
    from msk_ray.training import load_policy
    from msk_ray.visualize.look import describe_groups, geom_groups

    device = args.device or default_device()
    resolve_device(device)
    saved = None if checkpoint is None else load_policy(checkpoint)
    if saved is not None and task is not None and saved.config.env.name != task.name:
        raise ConfigError(f"{saved.path} acts in the task {saved.config.env.name}, not in {task.name}: leave TASK out")
    config = _config(task) if saved is None else saved.config
    evaluator, _ = Bench(device).evaluator(config, Request(args.physics, 1, None, args.steps))
    env = evaluator.env
    seed = config.evaluation.seed if args.seed is None else args.seed
    if saved is not None:
        policy = saved.on(env)
    else:
        policy = zero_policy(env) if args.agent == ZERO else random_policy(env, seed)
    groups = args.geom_groups or geom_groups(env.model)
    if args.geom_groups is None and (drawn := describe_groups(groups)):
        print(f"{drawn}; --geom-groups chooses")
    with _screen(args, env.model, groups) as screen:
        try:
            played = play_episodes(env, policy, evaluator.steps, seed, screen, args.speed)
            for number, episode in enumerate(played, 1):
                print(
                    f"episode {number}: score {episode.score:.5g}, {episode.seconds:.1f} s, {episode.ending}",
                    flush=True,
                )
                if number == args.episodes:
                    break
        except KeyboardInterrupt:
            print()
    return 0


def _take_policy(args: argparse.Namespace) -> None:
    """Where TASK is no task but the name of a policy in `policies/`, take it as --agent."""
    if args.task not in shipped_names(POLICIES, ".pt") or ENVIRONMENTS.find(args.task) is not None:
        return
    if args.agent != ZOO:
        raise ConfigError(f"{args.task} is a policy in policies/, not a task: leave --agent out, or name its task")
    args.task, args.agent = None, args.task


def _check(args: argparse.Namespace) -> None:
    """Refuse a command line that cannot work, before anything slow starts."""
    if args.task is None and args.agent in (ZOO, ZERO, RANDOM):
        raise ConfigError("name a task, as msk-ray list does, or a policy: --agent runs/demo")
    if not 0.0 < args.speed <= 1000.0:  # NaN is neither
        raise ConfigError(f"--speed {args.speed:g}: write a number above 0, up to 1000")
    if args.seed is not None:
        parse_seeds(args.seed)
    if args.port is not None and not args.browser:
        raise ConfigError("--port: only --browser reads it; leave it out")
    if args.browser:
        if find_spec("mjviser") is None:
            raise ConfigError("--browser needs mjviser: pip install 'msk-ray[browser]'")
    elif sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise DeviceError(NO_DISPLAY)


def _checkpoint(args: argparse.Namespace, task: Task | None) -> Path | None:
    """The policy that acts; None if none does.

    Raises:
        ConfigError: the task has no policy in `policies/`. StorageError, CheckpointError: there is no such policy.
    """
    if args.agent in (ZERO, RANDOM):
        return None
    if args.agent != ZOO:
        return checkpoint_of(find_target(args.agent, args.storage))
    assert task is not None
    if task.best is None:
        raise ConfigError(f"policies/ has no policy for {task.name}: write --agent zero, random, or a policy's path")
    return find_shipped(task.best, POLICIES, ".pt")


def _config(task: Task | None) -> Config:
    """The settings of a task: those of its own config, or the defaults."""
    assert task is not None
    return load_config(task.configs[0]) if task.configs else parse_config({"env": {"name": task.name}}, task.name)


def _screen(
    args: argparse.Namespace, model: "mujoco.MjModel", groups: Sequence[int]
) -> AbstractContextManager["Screen"]:
    if args.browser:
        from msk_ray.play.browser import browser

        return browser(model, groups, _PORT if args.port is None else args.port)
    from msk_ray.play.desktop import desktop

    return desktop(model, groups)


if __name__ == "__main__":
    sys.exit(run(main))
