"""Reading a trial's `metrics.jsonl`, apart from writing it: who only looks need not load torch."""

import json
from pathlib import Path
from typing import Any

from msk_ray.errors import StorageError

METRICS_FILE = "metrics.jsonl"


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Rows of a metrics file in order of epoch, each epoch once (its latest row); a torn last line is left out."""
    if not path.is_file():
        return []
    rows: dict[int, dict[str, Any]] = {}
    lines = path.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line)
        except ValueError as error:
            if number == len(lines):
                break  # the writer was killed in the middle of it
            raise StorageError(f"{path}, line {number} is not JSON: {error}") from error
        rows[int(row["epoch"])] = row
    return [rows[epoch] for epoch in sorted(rows)]
