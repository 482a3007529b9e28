"""`metrics.jsonl`: one JSON object per line, written before any other logger gets the row."""

import json
import math
import os
from pathlib import Path
from typing import Any

from msk_ray.experiment.damage import Damage
from msk_ray.experiment.layout import METRICS_FILE
from msk_ray.experiment.metrics import load_metrics
from msk_ray.files import append_text, write_bytes


class JsonLines:
    """Appends rows to `metrics.jsonl`, which status, reports and resumed trials read.

    Non-finite values are written as null and named in the row's `nonfinite` list, because JSON has no NaN.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / METRICS_FILE

    def rewind(self, epoch: int) -> tuple[Damage, ...]:
        """Drop rows after `epoch`, which a resumed trial will write again, and damaged lines.

        Returns:
            The damaged lines.

        Raises:
            StorageError: the rows cannot be read or written.
        """
        if not os.path.lexists(self._path):
            return ()
        metrics = load_metrics(self._path)
        rows = [row for row in metrics.rows if row["epoch"] <= epoch]
        write_bytes(self._path, "".join(json.dumps(row) + "\n" for row in rows).encode())
        return metrics.damages

    def write(self, row: dict[str, float]) -> None:
        """Append one row, and flush it.

        Raises:
            StorageFailure: the disk is full or gone.
        """
        bad = [name for name, value in row.items() if not math.isfinite(value)]
        clean: dict[str, Any] = {name: None if name in bad else value for name, value in row.items()}
        clean["epoch"] = int(row["epoch"])
        if bad:
            clean["nonfinite"] = bad
        append_text(self._path, json.dumps(clean) + "\n", sync=True)
