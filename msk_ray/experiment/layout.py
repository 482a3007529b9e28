"""What the files of an experiment and of its trials are called."""

from pathlib import Path

MANIFEST_FILE = "manifest.json"
SPACE_FILE = "space.yaml"
ENVIRONMENT_FILE = "env.json"
SCHEDULER_LOG_FILE = "reports.jsonl"
SUMMARY_FILE = "summary.json"
"""What a driver writes, with the table, when it ends by itself."""
STOP_FILE = "stop"
"""While this file lies in the experiment's folder, trials save themselves and end at their next epoch."""

METRICS_FILE = "metrics.jsonl"
OUTCOME_FILE = "outcome.json"
HALVED_FILE = "halved.json"
DEVICE_FILE = "device.json"
PARAMS_FILE = "params.json"
EVAL_FILE = "eval.json"
OUTPUT_FILE = "output.log"
ERROR_FILE = "error.txt"
HANG_FILE = "hang.txt"
ABANDONED = "abandoned"
"""Folder, in the trial's own, of what was done with all its worlds."""


def best_checkpoint(folder: Path) -> Path:
    """Where the best policy of the trial in `folder` is kept."""
    return folder / "checkpoints" / "best.pt"
