"""Trials on their own, as `train` leaves them."""

import json
import time
from pathlib import Path

from msk_ray.experiment.ownership import owned
from msk_ray.experiment.records import find_experiments
from msk_ray.experiment.snapshot import State
from msk_ray.experiment.trainings import TrainingReader


def fill(folder: Path, last: int, config: str = "env: {name: 'gone:Robot'}\ntrial: {epochs: 4}\n") -> None:
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(config)
    (folder / "env.json").write_text("{}")
    rows = [{"epoch": n, "env_steps": n, "seconds": 2.0 * n, "eval/score": 10.0 + n} for n in range(last + 1)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def test_they_are_found_with_their_states(tmp_path: Path) -> None:
    fill(tmp_path / "train" / "done", 4)
    fill(tmp_path / "train" / "stopped", 2)
    fill(tmp_path / "train" / "torn", 1, "trial: [")
    fill(tmp_path / "beside", 3)
    (tmp_path / "train" / "empty").mkdir()
    reader = TrainingReader(tmp_path)
    with owned(tmp_path / "train" / "stopped"):
        trainings = {training.name: training for training in reader.look(time.time())}
    assert list(trainings) == ["beside", "train/done", "train/stopped", "train/torn"]
    assert (trainings["train/done"].state, trainings["train/stopped"].state) == (State.ENDED, State.RUNNING)
    done = trainings["train/done"]
    # Its environment cannot be imported here, which its state does not need.
    assert (done.environment, done.progress.epoch, done.epochs, done.progress.best) == ("gone:Robot", 4, 4, 14.0)
    assert "not valid YAML" in trainings["train/torn"].note
    assert find_experiments(tmp_path) == []
