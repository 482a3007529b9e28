"""`python -m msk_ray.tune` whose trials take milliseconds; for a process of its own.

It starts a dashboard if STUB_DASHBOARD is set, and Ray may be silent for STUB_SILENCE seconds.
"""

from msk_ray import signals

if __name__ == "__main__":
    signals.listen()

import functools
import os
import sys
import time
from pathlib import Path
from typing import Any

import stub_trainer
from lean_ray import lean_ray
from ray import cloudpickle
from stub_trainer import StubTrainer

from msk_ray.cli import run
from msk_ray.tune import driver, session
from msk_ray.tune.__main__ import main
from msk_ray.tune.ray_watch import RayWatch


def compile_for_ever(*of_trial: Any) -> None:
    """Kernels that take their time; says that it has begun."""
    Path(os.environ["STUB_COMPILES"]).touch()
    time.sleep(3600)


if __name__ == "__main__":
    cloudpickle.register_pickle_by_value(stub_trainer)
    precompile = compile_for_ever if "STUB_COMPILES" in os.environ else None
    driver.Plan = functools.partial(  # type: ignore[assignment,misc]
        driver.Plan, make_trainer=StubTrainer, precompile=precompile, prestart=False
    )
    RayWatch.LIMIT_S = float(os.environ.get("STUB_SILENCE", RayWatch.LIMIT_S))
    shown = bool(os.environ.get("STUB_DASHBOARD"))
    session.ray_session = functools.partial(session.ray_session, dashboard=None if shown else False, trials=False)
    with lean_ray(dashboard=shown):
        code = run(main)
    assert "torch" not in sys.modules, "only trials need it, and it takes seconds to load"
    sys.exit(code)
