"""`evaluate --in mjlab`: a policy in mjlab's unmodified velocity task, in a Python of its own.

mjlab 1.6 needs MuJoCo 3.11 and msk_ray 4.0, so one environment cannot hold both.

Axes: W worlds, O observation, J actions.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from msk_ray.config import Config
from msk_ray.errors import ConfigError
from msk_ray.evaluate.foreign_process import ForeignProcess
from msk_ray.evaluate.measure import EvaluationSetup, Request, entry_of
from msk_ray.robots.config import VelocitySettings
from msk_ray.robots.mjlab import worker
from msk_ray.robots.mjlab.elsewhere import MJLAB
from msk_ray.training import SavedPolicy
from msk_ray.training.episodes import Episodes
from msk_ray.training.threads import use_threads

TASKS: Final = {
    "go1_velocity": "Mjlab-Velocity-Flat-Unitree-Go1",
    "go1_velocity_rough": "Mjlab-Velocity-Rough-Unitree-Go1",
    "g1_velocity": "Mjlab-Velocity-Flat-Unitree-G1",
}
"""By name, because a class derived from one of these may be another robot with as many joints."""
PLAY: Final = "mjlab play"
PUSHED: Final = "mjlab pushed"
"""With the pushes and the noise of mjlab's training; friction, encoder bias and centre of mass are random in both."""
EPISODES_ON_GPU: Final = 256
EPISODES_ON_CPU: Final = 8
STEPS: Final = 1000


def task_of(config: Config) -> str:
    """The task of mjlab in which a trial's policy acts.

    Raises:
        ConfigError: there is none.
    """
    env = config.env
    task = TASKS.get(env.name)
    if task is None:
        raise ConfigError(f"--in mjlab: env {env.name} is not a task of mjlab; train on one of {', '.join(TASKS)}")
    if env.control_timestep != VelocitySettings.model_fields["control_timestep"].default:
        raise ConfigError(
            f"--in mjlab: trained with a control step of {env.control_timestep:g} s, but mjlab's is 0.02 s; leave out "
            "env.control_timestep"
        )
    return task


class MjlabScorer:
    """Evaluates policies in mjlab.

    Args:
        python: the interpreter of an environment that has mjlab.
    """

    def __init__(self, python: Path) -> None:
        self._python = python.absolute()  # not resolved: a virtual environment's is a link to another

    def check(self, config: Config, request: Request) -> None:
        """Raise ConfigError if a trial's policy does not act in this environment. Runs nothing."""
        task_of(config)

    def requests(self, worlds: int | None, seeds: tuple[int, ...] | None, steps: int | None) -> list[Request]:
        """With mjlab's settings for playing, and with pushes and noise: 256 episodes of 1000 steps on a GPU, 8 on a
        CPU, with seed 0, unless other numbers are given."""
        episodes = EPISODES_ON_GPU if torch.cuda.is_available() else EPISODES_ON_CPU
        return [Request(name, worlds or episodes, seeds or (0,), steps or STEPS) for name in (PLAY, PUSHED)]

    def evaluate(self, policy: SavedPolicy, request: Request) -> dict[str, Any]:
        """One entry of `eval.json`: what was evaluated, how, and the results. `request` is one of `requests`.

        Raises:
            ConfigError: the policy does not act in this environment, or mjlab is missing or of another version.
            SimulationError: mjlab stopped.
        """
        task = task_of(policy.config)
        use_threads(policy.config)
        assert request.worlds is not None
        assert request.steps is not None
        seeds = request.seeds or (0,)
        asked = {"task": task, "pushed": request.physics == PUSHED, "worlds": request.worlds, "steps": request.steps}
        runs = []
        for seed in seeds:
            with _Worker(self._python, {**asked, "seed": seed}) as running:
                runs.append(running.episodes(policy))
        setup = EvaluationSetup(request.physics, False, request.worlds, seeds, request.steps, running.device)
        return entry_of(policy, setup, runs, running.terms) | {"mjlab": running.versions}


class _Worker(ForeignProcess):
    """A process of mjlab's Python.

    Attributes:
        device: it runs on.
        terms: names of the parts of the reward.
    """

    def __init__(self, python: Path, asked: dict[str, Any]) -> None:
        super().__init__(MJLAB, python, worker.__file__, asked)
        self._asked = asked
        self.device: str = self.hello["device"]
        self.terms: list[str] = self.hello["terms"]
        self._observations: int = self.hello["observations"]
        self._record = worker.record(self._observations, len(self.terms))

    def episodes(self, policy: SavedPolicy) -> Episodes:
        """The first episode of each world."""
        assert isinstance(policy.config.env, VelocitySettings)
        worlds, scale = self._asked["worlds"], policy.config.env.action_range
        obs = self.read(np.dtype(("<f4", (self._observations,))), worlds)
        running = np.ones(worlds, dtype=bool)
        fell = np.zeros(worlds, dtype=bool)
        length = np.zeros(worlds)
        sums = {name: np.zeros((worlds, *self._record[name].shape)) for name in _SUMMED}
        for _ in range(self._asked["steps"]):
            self.write(scale * policy(obs))
            step = self.read(self._record, worlds)
            length += running
            ended = running & step["terminated"]
            for name, total in sums.items():
                # A world that fell is elsewhere already when errors are measured.
                counted = running & ~ended if name in worker.ERRORS else running
                total[counted] += step[name][counted]
            fell |= ended
            running &= ~ended
            obs = np.ascontiguousarray(step["obs"])
        return Episodes(
            score=torch.from_numpy(sums["reward"]),
            length=torch.from_numpy(length),
            fell=torch.from_numpy(fell),
            diverged=torch.from_numpy(~np.isfinite(sums["reward"])),
            terms=torch.from_numpy(sums["terms"]),
            outcomes={name: torch.from_numpy(sums[name]) for name in worker.ERRORS},
            success=None,
        )


_SUMMED: Final = ("reward", "terms", *worker.ERRORS)
