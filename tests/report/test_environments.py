"""An experiment over several environments: a part of the page for each, because their scores cannot be compared."""

import json
import time
from pathlib import Path

import pytest

from msk_ray.config import dump_yaml
from msk_ray.experiment.outcomes import Ending, Outcome, write_ending
from msk_ray.report.__main__ import main
from msk_ray.report.reading import read_experiment
from msk_ray.report.tables import baseline_of, variant_rows
from msk_ray.sweep import opening
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import resolve_trials

pytestmark = pytest.mark.long


def test_each_environment_is_a_part_of_the_page(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(dump_yaml({"env": {"name": "cartpole"}, "trial": {"epochs": 4}}))
    bodies = [{"label": name, "value": {"name": name}} for name in ("hopper", "cheetah")]
    data = {
        "question": "Which?",
        "base": "base.yaml",
        "parameters": {"env": {"grid": bodies}},
        "ablate": {"variants": {"fast": {"shac.actor_lr": 0.1}}},
    }
    space = parse_space(data, tmp_path / "bodies.yaml")
    made = opening.create(tmp_path / "runs" / "bodies", space, resolve_trials(space), {})
    for trial in made.trials():
        folder = made.trial_folder(trial.id)
        folder.mkdir(parents=True, exist_ok=True)
        factor = 100.0 if trial.changed["env"] == "cheetah" else 1.0
        score = factor * (2.0 if trial.changed["variant"] == "fast" else 1.0)
        rows = [
            {"epoch": e, "env_steps": 100 * e, "seconds": 2.0 * e, "env_steps_per_s": 50.0, "eval/score": score * e}
            for e in (0, 2, 4)
        ]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        write_ending(folder, Ending(Outcome.FINISHED, "all 4 epochs done"))
    reading = read_experiment(made, time.time())
    parts = reading.parts()
    assert [(part.name, len(part.trials)) for part in parts] == [("bodies: hopper", 2), ("bodies: cheetah", 2)]
    assert parts[0].parts() == [parts[0]]
    hopper = variant_rows(parts[0], baseline_of(parts[0], None))
    assert [(row.variant, row.mean, row.difference) for row in hopper] == [
        ("hopper, fast", 8.0, 4.0),
        ("hopper, baseline", 4.0, None),
    ]
    assert main([str(made.path), "--best", "never"]) == 0
    page = (made.path / "report" / "index.html").read_text()
    assert "Scores of different environments cannot be compared." in page
    assert page.count("bodies: hopper") >= 2
    assert (made.path / "report" / "1_curves.png").is_file()
    assert (made.path / "report" / "2_curves.png").is_file()
