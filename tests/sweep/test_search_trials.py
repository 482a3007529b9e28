"""What a search suggested, as resuming finds it."""

import os
from pathlib import Path
from typing import Any

from msk_ray.sweep import opening
from msk_ray.sweep.search_trials import recover, search_trial, write_params
from msk_ray.sweep.trials import base_settings


def test_a_trial_that_starts_again_keeps_its_place(make_space: Any, tmp_path: Path) -> None:
    space = make_space(
        parameters={"shac.actor_lr": {"loguniform": [1e-3, 1e-2]}}, search="optuna", samples=3, seeds="0"
    )
    experiment = opening.create(tmp_path / "e", space, [], {})
    suggested = [{"shac.actor_lr": rate} for rate in (0.005, 0.002, 0.003)]
    folders = []
    for place, params in enumerate(suggested):
        folder = experiment.make_trial_folder(search_trial(space, base_settings(space), params).id)
        write_params(folder, params)
        os.utime(folder / "params.json", (place, place))
        folders.append(folder)
    write_params(folders[0], suggested[0])  # as its second process does
    assert [suggestion.params for suggestion in recover(experiment, space)] == suggested
    assert [suggestion.trial.index for suggestion in recover(experiment, space)] == [0, 1, 2]
