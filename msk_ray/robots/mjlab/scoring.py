"""`evaluate --in mjlab`: evaluates a policy in mjlab's unmodified velocity or tracking task, in another Python.

mjlab 1.6 needs MuJoCo 3.11 and msk_ray 4.0, so one environment cannot hold both.

Axes: W worlds, O observation, J actions.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from msk_ray.config import Config
from msk_ray.errors import ConfigError
from msk_ray.evaluate.foreign_process import ForeignProcess
from msk_ray.evaluate.measure import EvaluationSetup, Request, entry_of
from msk_ray.progress import Pace, announce
from msk_ray.robots.config import ServoSettings
from msk_ray.robots.mjlab import mjlab_side
from msk_ray.robots.mjlab.declaration import MJLAB
from msk_ray.robots.servos import action_scale_of
from msk_ray.robots.tracking.config import G1TrackingSettings
from msk_ray.robots.tracking.env import G1Tracking
from msk_ray.robots.tracking.motions import Clip, read_motions
from msk_ray.training import SavedPolicy
from msk_ray.training.evaluation_tally import Episodes
from msk_ray.training.threads import use_threads

Observations = NDArray[np.float32]

TASKS: Final = {
    "go1_velocity": "Mjlab-Velocity-Flat-Unitree-Go1",
    "go1_velocity_rough": "Mjlab-Velocity-Rough-Unitree-Go1",
    "g1_velocity": "Mjlab-Velocity-Flat-Unitree-G1",
    "g1_tracking": "Mjlab-Tracking-Flat-Unitree-G1",
}
"""mjlab's task for each environment, by its name: a class derived from one may be another robot with as many joints."""
PLAY: Final = "mjlab play"
"""mjlab's settings for playing: friction, encoder bias and centre of mass are random. Episodes along a motion begin
where `env.score_sampling` says."""
PUSHED: Final = "mjlab pushed"
"""The same with the pushes and the noise of mjlab's training."""
EPISODES_ON_GPU: Final = 256
EPISODES_ON_CPU: Final = 8
STEPS: Final = 1000


def task_of(config: Config) -> str:
    """Name of the mjlab task that a trial's policy can act in.

    Raises:
        ConfigError: there is none.
    """
    env = config.env
    task = TASKS.get(env.name)
    if task is None:
        raise ConfigError(f"--in mjlab: env {env.name} is not a task of mjlab; train on one of {', '.join(TASKS)}")
    if env.control_timestep != ServoSettings.model_fields["control_timestep"].default:
        raise ConfigError(
            f"--in mjlab: trained with a control step of {env.control_timestep:g} s, but mjlab's is 0.02 s; leave out "
            "env.control_timestep"
        )
    if isinstance(env, G1TrackingSettings):
        if env.mirror:
            raise ConfigError("--in mjlab: mjlab follows one clip, not its mirror image too: not with env.mirror")
        task += {"full": "", "no_state_estimation": "-No-State-Estimation"}[env.layout]
    return task


@contextmanager
def motion_of(config: Config) -> Iterator[str | None]:
    """Path of a temporary file with the clip that a policy follows, for mjlab; None if it follows none.

    Raises:
        ConfigError: the policy follows several clips.
    """
    env = config.env
    if not isinstance(env, G1TrackingSettings):
        yield None
        return
    model = G1Tracking.build_model(env, config.physics)
    motions = read_motions(env.motion, model)
    if len(motions) > 1:
        raise ConfigError(f"--in mjlab: it follows one clip, not the {len(motions)} of env.motion {env.motion}")
    motion = motions[0].part(1.0 / env.control_timestep, env.cut)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "motion.npz"
        Clip.of(motion, model).save(path)
        yield str(path)


def mjlab_actions(config: Config) -> Callable[[Observations, Observations], Observations]:
    """A function from observations (W, O) and the policy's actions for them (W, J) to mjlab's actions (W, J)."""
    env = config.env
    assert isinstance(env, ServoSettings)
    scale = env.action_range
    if not isinstance(env, G1TrackingSettings) or env.action_about == "default":
        return lambda obs, action: scale * action
    model = G1Tracking.build_model(env, config.physics)
    pose, angles = model.key_qpos[0, 7:].astype(np.float32), action_scale_of(model).astype(np.float32)
    # The observation begins with the reference's angles.
    return lambda obs, action: scale * action + (obs[:, : len(pose)] - pose) / angles


class MjlabScorer:
    """Evaluates policies in mjlab.

    Args:
        python: the interpreter of an environment that has mjlab.
    """

    def __init__(self, python: Path) -> None:
        # Not resolved: the interpreter of a virtual environment is a link to another one.
        self._python = python.absolute()

    def check(self, config: Config, request: Request) -> None:
        """Raise ConfigError if a trial's policy cannot act in a task of mjlab. Runs nothing."""
        task_of(config)

    def requests(self, worlds: int | None, seeds: tuple[int, ...] | None, steps: int | None) -> list[Request]:
        """Two requests, `PLAY` and `PUSHED`: 256 episodes of 1000 steps on a GPU, 8 on a CPU, with seed 0, unless other
        numbers are given."""
        episodes = EPISODES_ON_GPU if torch.cuda.is_available() else EPISODES_ON_CPU
        return [Request(name, worlds or episodes, seeds or (0,), steps or STEPS) for name in (PLAY, PUSHED)]

    def evaluate(self, policy: SavedPolicy, request: Request) -> dict[str, Any]:
        """One entry of `eval.json`: what was evaluated, how, and the results. `request` is one of `requests`.

        Raises:
            ConfigError: the policy cannot act in a task of mjlab, or mjlab is missing or has another version.
            SimulationError: mjlab stopped.
        """
        task = task_of(policy.config)
        use_threads(policy.config)
        assert request.worlds is not None
        assert request.steps is not None
        seeds = request.seeds or (0,)
        env = policy.config.env
        tracking = env if isinstance(env, G1TrackingSettings) else None
        order = {
            "task": task,
            "pushed": request.physics == PUSHED,
            "worlds": request.worlds,
            "steps": request.steps,
            "sampling": tracking.score_sampling if tracking else None,
            "future": tracking.future_frames if tracking else (),
        }
        runs = []
        with motion_of(policy.config) as motion:
            for seed in seeds:
                announce(f"{request.physics}: {request.worlds} episodes with seed {seed}; its kernels may come first")
                with _MjlabProcess(self._python, {**order, "seed": seed, "motion": motion}) as process:
                    runs.append(process.episodes(policy))
        setup = EvaluationSetup(request.physics, False, request.worlds, seeds, request.steps, process.device)
        return entry_of(policy, setup, runs, process.terms) | {"mjlab": process.versions}


class _MjlabProcess(ForeignProcess):
    """A process of mjlab's Python that runs the episodes of one seed.

    Args:
        python: the interpreter.
        order: what to run, as `mjlab_side` describes.

    Attributes:
        device: name of the device that it runs on.
        terms: names of the reward terms.
    """

    def __init__(self, python: Path, order: dict[str, Any]) -> None:
        super().__init__(MJLAB, python, mjlab_side.__file__, order)
        self._order = order
        self.device: str = self.hello["device"]
        self.terms: list[str] = self.hello["terms"]
        self._observations: int = self.hello["observations"]
        command = mjlab_side.command_name(order["motion"])
        self._record = mjlab_side.record(self._observations, len(self.terms), command)
        self._errors = mjlab_side.ERRORS[command]

    def episodes(self, policy: SavedPolicy) -> Episodes:
        """The first episode of each world."""
        worlds, actions = self._order["worlds"], mjlab_actions(policy.config)
        obs = self.read(np.dtype(("<f4", (self._observations,))), worlds)
        running = np.ones(worlds, dtype=bool)
        fell = np.zeros(worlds, dtype=bool)
        length = np.zeros(worlds)
        summed = ("reward", "terms", *self._errors)
        sums = {name: np.zeros((worlds, *self._record[name].shape)) for name in summed}
        steps = self._order["steps"]
        pace = Pace("env steps at most", steps)
        for done in range(1, steps + 1):
            self.write(actions(obs, policy(obs)))
            step = self.read(self._record, worlds)
            length += running
            ended = running & step["terminated"]
            for name, total in sums.items():
                # A world that fell has been reset before errors are measured.
                counted = running & ~ended if name in self._errors else running
                total[counted] += step[name][counted]
            fell |= ended
            running &= ~ended
            pace(done)
            if not running.any():
                break
            obs = step["obs"].copy()
        diverged = ~np.isfinite(sums["reward"])
        return Episodes(
            score=torch.from_numpy(sums["reward"]),
            length=torch.from_numpy(length),
            fell=torch.from_numpy(fell & ~diverged),
            diverged=torch.from_numpy(diverged),
            terms=torch.from_numpy(sums["terms"]),
            outcomes={name: torch.from_numpy(sums[name]) for name in self._errors},
            success=None,
        )
