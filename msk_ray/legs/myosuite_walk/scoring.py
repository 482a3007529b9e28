"""`evaluate --in myosuite`: a policy in the unmodified CPU environment of MyoSuite, in a Python of its own.

MyoSuite 2.12 needs MuJoCo 3.6 and msk_ray 4.0, so one environment cannot hold both.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from msk_ray.config import Config
from msk_ray.errors import ConfigError
from msk_ray.evaluate.foreign_process import ForeignProcess
from msk_ray.evaluate.measure import EvaluationSetup, Request, entry_of
from msk_ray.legs.myosuite_walk import myosuite_side
from msk_ray.legs.myosuite_walk.config import MyoSuiteWalkSettings
from msk_ray.legs.myosuite_walk.declaration import MYOSUITE
from msk_ray.legs.myosuite_walk.mirror import WalkMirror
from msk_ray.legs.myosuite_walk.model import build_myosuite_walk
from msk_ray.progress import Pace
from msk_ray.training import SavedPolicy
from msk_ray.training.evaluation_tally import Episodes
from msk_ray.training.threads import use_threads

ENVIRONMENT: Final = "myoLegWalk-v0"
RESETS: Final = ("init", "random")
"""MyoSuite's own resets, and those of `reset_type='random'`."""
EPISODES: Final = 20
STEPS: Final = 1000
_Act = Callable[[NDArray[np.float32]], NDArray[np.float32]]


def check_policy(config: Config) -> None:
    """Raise ConfigError unless a policy of this trial acts in MyoSuite's environment."""
    env = config.env
    if not isinstance(env, MyoSuiteWalkSettings):
        raise ConfigError(f"--in myosuite: env {env.name} is not a task of MyoSuite; train on env.name: myosuite_walk")
    if env.control_timestep != MyoSuiteWalkSettings.model_fields["control_timestep"].default:
        raise ConfigError(
            f"--in myosuite: trained with a control step of {env.control_timestep:g} s, but MyoSuite's is 0.01 s; "
            "leave out env.control_timestep"
        )


class MyoSuiteScorer:
    """Evaluates policies in MyoSuite.

    Args:
        python: the interpreter of an environment that has MyoSuite.
    """

    def __init__(self, python: Path) -> None:
        self._python = python.absolute()  # not resolved: a virtual environment's is a link to another

    def check(self, config: Config, request: Request) -> None:
        """Raise ConfigError if a trial's policy does not act in this environment. Runs nothing."""
        check_policy(config)

    def requests(self, worlds: int | None, seeds: tuple[int, ...] | None, steps: int | None) -> list[Request]:
        """One request for each kind of reset: 20 episodes of 1000 steps with seed 0, unless other numbers are given.

        Raises:
            ConfigError: more than 1000 steps, after which MyoSuite ends an episode.
        """
        if steps is not None and steps > STEPS:
            raise ConfigError(
                f"--steps {steps}: {ENVIRONMENT} ends an episode after {STEPS} steps; write at most {STEPS}"
            )
        return [Request(f"myosuite {reset}", worlds or EPISODES, seeds or (0,), steps or STEPS) for reset in RESETS]

    def evaluate(self, policy: SavedPolicy, request: Request) -> dict[str, Any]:
        """One entry of `eval.json`: what was evaluated, how, and the results. `request` is one of `requests`.

        Raises:
            ConfigError: the policy does not act in this environment, or MyoSuite is missing or of another version.
            SimulationError: MyoSuite stopped.
        """
        check_policy(policy.config)
        use_threads(policy.config)
        assert request.worlds is not None
        assert request.steps is not None
        seeds = request.seeds or (0,)
        reset = request.physics.removeprefix("myosuite ")
        act = _acting(policy)
        runs, versions = [], {}
        for seed in seeds:
            asked = {"env": ENVIRONMENT, "reset": reset, "seed": seed}
            with _MyoSuiteProcess(
                self._python, {**asked, "episodes": request.worlds, "steps": request.steps}
            ) as running:
                runs.append(running.episodes(act, request.worlds, request.steps))
                versions = running.versions
        setup = EvaluationSetup(request.physics, False, request.worlds, seeds, request.steps, "cpu")
        return entry_of(policy, setup, runs, myosuite_side.TERMS) | {"myosuite": versions}


def _acting(policy: SavedPolicy) -> _Act:
    """The action (U,) of a policy for an observation (O,) of MyoSuite."""
    env = policy.config.env
    assert isinstance(env, MyoSuiteWalkSettings)
    if not env.symmetric:
        return lambda obs: policy(obs[None])[0]
    mirror = WalkMirror(build_myosuite_walk(env, policy.config.physics), torch.device("cpu"))

    def act(obs: NDArray[np.float32]) -> NDArray[np.float32]:
        row = torch.from_numpy(obs[None])
        action = torch.from_numpy(policy(mirror.observation(row).numpy()))
        exchanged: NDArray[np.float32] = mirror.action(mirror.exchanged(row), action)[0].numpy()
        return exchanged

    return act


class _MyoSuiteProcess(ForeignProcess):
    """A process of MyoSuite's Python."""

    def __init__(self, python: Path, asked: dict[str, Any]) -> None:
        super().__init__(MYOSUITE, python, myosuite_side.__file__, asked)
        self._record = myosuite_side.record(self.hello["observations"])

    def episodes(self, act: _Act, count: int, steps: int) -> Episodes:
        """`count` episodes of at most `steps` steps, one after the other, as a tensor entry each."""
        found: list[np.ndarray] = []
        pace = Pace("episodes", count)
        while len(found) < count:
            found.append(self._episode(act, steps))
            pace(len(found))
        last = [episode[-1] for episode in found]

        def summed(name: str) -> torch.Tensor:
            return torch.from_numpy(np.stack([episode[name].sum(0) for episode in found]))

        diverged = torch.tensor([bool(step["diverged"]) for step in last])
        return Episodes(
            score=summed("reward"),
            length=torch.tensor([float(len(episode)) for episode in found]),
            fell=torch.tensor([bool(step["terminated"]) for step in last]) & ~diverged,
            diverged=diverged,
            terms=summed("terms"),
            outcomes={"vx": summed("forward"), "activation": summed("activation")},
            success=None,
        )

    def _episode(self, act: _Act, steps: int) -> np.ndarray:
        """Records of one episode, (T,)."""
        found: list[np.ndarray] = []
        obs = self.read(self._record, 1)[0]["obs"]
        while len(found) < steps:
            self.write(act(obs))
            found.append(self.read(self._record, 1)[0])
            obs = found[-1]["obs"]
            if found[-1]["terminated"] or found[-1]["diverged"]:
                break
        return np.stack(found)
