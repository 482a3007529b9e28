"""Where the simulation's figures go in an epoch's row."""

from pathlib import Path

import pytest

from msk_ray.config import Config
from msk_ray.training import Trainer


def test_figures_are_filed_by_what_they_speak_of(
    tiny_cartpole: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = Trainer(tiny_cartpole, tmp_path, "cpu")
    monkeypatch.setattr(trainer.env.sim, "diagnostics", lambda: {"approximated_share": 0.25, "solver_limit_share": 0.5})
    row = trainer.run_epoch()
    trainer.close()
    assert row["grad/approximated_share"] == 0.25
    assert row["physics/solver_limit_share"] == 0.5
    assert "physics/approximated_share" not in row
