"""One trial: train, evaluate, log, checkpoint, resume. Independent of Ray."""

from msk_ray.step.garbage import lasting_imports

with lasting_imports():
    from msk_ray.experiment.metrics import read_metrics
    from msk_ray.training.checkpoint import newest_valid_checkpoint, read_checkpoint
    from msk_ray.training.evaluation import Evaluator
    from msk_ray.training.parallel import ParallelTrainer, make_trainer
    from msk_ray.training.policy import SavedPolicy, load_policy
    from msk_ray.training.trainer import MOST_TOGETHER, Trainer, precompile

__all__ = [
    "MOST_TOGETHER",
    "Evaluator",
    "ParallelTrainer",
    "SavedPolicy",
    "Trainer",
    "load_policy",
    "make_trainer",
    "newest_valid_checkpoint",
    "precompile",
    "read_checkpoint",
    "read_metrics",
]
