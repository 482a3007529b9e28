"""The PPO baseline trains and writes rows that curves can be drawn from."""

import json
import math
import runpy
import sys
from pathlib import Path

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "ppo.py"
CARTPOLE = BENCHMARK.parents[1] / "configs" / "cartpole.yaml"


def test_it_trains_and_evaluates_like_shac(tmp_path, monkeypatch):
    arguments = f"--config {CARTPOLE} --nworld 8 --steps 4 --iterations 2 --evaluate-every 1 --device cpu"
    monkeypatch.setattr(sys, "argv", ["ppo.py", *arguments.split(), "--logdir", str(tmp_path)])
    runpy.run_path(str(BENCHMARK), run_name="__main__")
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["epoch"] for row in rows] == [0, 1, 2]
    assert [row["env_steps"] for row in rows] == [0, 32, 64]
    assert all(math.isfinite(row["eval/score"]) for row in rows)
    assert rows[2]["eval/score"] != rows[0]["eval/score"]  # the policy has changed
    assert rows[2]["eval/best_score"] == max(row["eval/score"] for row in rows)
