"""An experiment over two environments that has ended, made without training."""

import json
from pathlib import Path

from msk_ray.config import dump_yaml
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.outcomes import Ending, Outcome, write_ending
from msk_ray.sweep import opening
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import resolve_trials

FACTORS = {"hopper": 1.0, "cheetah": 100.0}
"""Environment → the factor of its scores."""


def make_bodies(folder: Path) -> Experiment:
    """Two environments by two variants by two seeds, four epochs each.

    The scores are the epoch times 1 for SHAC and 2 for `fast`, plus half of that for seed 1, times the environment's
    factor; `fast` needs twice the seconds, and so does seed 1.
    """
    (folder / "base.yaml").write_text(dump_yaml({"env": {"name": "cartpole"}, "trial": {"epochs": 4}}))
    data = {
        "question": "Which?",
        "base": "base.yaml",
        "parameters": {"env": {"grid": [{"label": name, "value": {"name": name}} for name in FACTORS]}},
        "ablate": {"label": "SHAC", "variants": {"fast": {"shac.actor_lr": 0.1}}},
        "seeds": "0-1",
    }
    space = parse_space(data, folder / "bodies.yaml")
    made = opening.create(folder / "runs" / "bodies", space, resolve_trials(space), {})
    for trial in made.trials():
        own = made.trial_folder(trial.id)
        own.mkdir(parents=True, exist_ok=True)
        pace = 2.0 if trial.changed["variant"] == "fast" else 1.0
        slope = FACTORS[trial.changed["env"]] * pace * (1.0 + 0.5 * trial.seed)
        rows = [
            {"epoch": e, "env_steps": 100 * e, "seconds": pace * (1 + trial.seed) * e, "env_steps_per_s": 50.0}
            | {"eval/score": slope * e}
            for e in (0, 2, 4)
        ]
        (own / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        write_ending(own, Ending(Outcome.FINISHED, "all 4 epochs done"))
    return made
