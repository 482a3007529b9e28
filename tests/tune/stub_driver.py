"""`python -m msk_ray.tune` whose trials take milliseconds; for a process of its own."""

import functools
import sys

import stub_trainer
from ray import cloudpickle
from stub_trainer import StubTrainer

from msk_ray.cli import run
from msk_ray.tune import runner
from msk_ray.tune.__main__ import main

if __name__ == "__main__":
    cloudpickle.register_pickle_by_value(stub_trainer)
    runner.Plan = functools.partial(  # type: ignore[assignment,misc]
        runner.Plan, trainer_class=StubTrainer, precompile=None, standby=False
    )
    runner.ray_session = functools.partial(runner.ray_session, dashboard=False, trials=False)
    sys.exit(run(main))
