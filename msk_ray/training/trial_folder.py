"""Where a trial that is being trained keeps its files, and how far it is."""

from pathlib import Path

from msk_ray.config import Config
from msk_ray.experiment.layout import best_checkpoint_in


class TrialFolder:
    """What trainers in one process and in several have in common.

    Attributes:
        config: the trial's config.
        logdir: its folder.
        epoch: number of epochs done.
    """

    def __init__(self, config: Config, logdir: Path) -> None:
        self.config = config
        self.logdir = logdir
        self.epoch = 0

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.logdir / "checkpoints"

    @property
    def best_checkpoint(self) -> Path:
        """Checkpoint of the policy with the best evaluation score."""
        return best_checkpoint_in(self.logdir)

    @property
    def finished(self) -> bool:
        """Whether all epochs are done."""
        return self.epoch >= self.config.trial.epochs
