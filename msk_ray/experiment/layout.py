"""The names of the files of an experiment and of its trials."""

from pathlib import Path

MANIFEST_FILE = "manifest.json"
SPACE_FILE = "space.yaml"
ENVIRONMENT_FILE = "env.json"
EVALUATION_LOG_FILE = "reports.jsonl"
SUMMARY_FILE = "summary.json"
"""Written by a driver, with the table, when it ends normally."""
NOTES_FILE = "notes.json"
"""Notes that people have written about trials."""
STOP_FILE = "stop"
"""While the experiment's folder contains this file, trials save themselves and end at their next epoch."""

CONFIG_FILE = "config.yaml"
METRICS_FILE = "metrics.jsonl"
OUTCOME_FILE = "outcome.json"
ATTEMPT_FILE = "halved.json"
"""Which attempt the folder holds; only the second, which has half the worlds, has this file."""
DEVICE_FILE = "device.json"
PARAMS_FILE = "params.json"
EVAL_FILE = "eval.json"
OUTPUT_FILE = "output.log"
ERROR_FILE = "error.txt"
HANG_FILE = "hang.txt"
ABANDONED = "abandoned"
"""Subfolder of a trial that was restarted with half its worlds, with the files of its first attempt."""


def best_checkpoint_in(folder: Path) -> Path:
    """Path of the best policy of the trial in `folder`."""
    return folder / "checkpoints" / "best.pt"
