"""What sweeps are compared with: every trial trained alone."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fault_campaign.space import EPOCHS, TIMING
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.outcomes import read_ending
from msk_ray.experiment.trial import Trial
from msk_ray.training import Trainer, read_checkpoint

LAST, BEST = f"epoch_{EPOCHS:06d}.pt", "best.pt"


@dataclass
class Lost:
    """How much is missing or differs."""

    rows: int = 0
    trials: int = 0
    policies: int = 0


class Reference:
    """Every trial of the space, trained without Ray and without faults."""

    def __init__(self, trials: list[Trial], folder: Path) -> None:
        self.trials = trials
        self._folder = folder
        for trial in trials:
            trainer = Trainer(trial.config, folder / trial.id, "cpu")
            while not trainer.finished:
                trainer.run_epoch()
            trainer.close()

    def folder_of(self, trial: Trial) -> Path:
        """Of a trial that was left alone."""
        return self._folder / trial.id

    def compare(self, experiment: Path, trials: list[Trial]) -> tuple[Lost, list[str]]:
        """What of an experiment is missing or differs, and what is wrong with it."""
        lost = Lost()
        notes = []
        for trial in trials:
            folder = experiment / "trials" / trial.id
            expected, found = read_rows(self._folder / trial.id), read_rows(folder)
            assert len(expected) == EPOCHS + 1
            by_epoch = {row["epoch"]: _without_timing(row) for row in found}
            wrong = [row["epoch"] for row in expected if by_epoch.get(row["epoch"]) != _without_timing(row)]
            wrong += [row["epoch"] for row in found if row["epoch"] > EPOCHS]
            lost.rows += len(wrong)
            ending = read_ending(folder)
            whole = (
                ending is not None
                and ending.outcome == "finished"
                and _same(_state(self._folder / trial.id, LAST), _state(folder, LAST))
            )
            lost.trials += not whole
            best = _same(_state(self._folder / trial.id, BEST), _state(folder, BEST))
            lost.policies += not best
            if wrong or not whole or not best:
                notes.append(
                    f"{trial.id}: rows {wrong} missing or different, ended {ending}, best policy "
                    f"{'the same' if best else 'missing or different'}"
                )
        return lost, notes


def _without_timing(row: dict[str, float]) -> dict[str, Any]:
    return {key: repr(value) for key, value in row.items() if not key.startswith(TIMING)}


def _state(folder: Path, name: str) -> dict[str, Any] | None:
    path = folder / "checkpoints" / name
    return {k: v for k, v in read_checkpoint(path).items() if k not in TIMING} if path.is_file() else None


def _same(a: Any, b: Any) -> bool:
    """Whether nested containers hold the same structure and bit-equal tensors."""
    import torch

    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and torch.equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return isinstance(b, (list, tuple)) and len(a) == len(b) and all(map(_same, a, b))
    return bool(a == b)
