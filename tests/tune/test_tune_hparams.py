"""The table of hyperparameters: settings from the sweep, scores from the trial's own scalars."""

from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import metadata, plugin_data_pb2

from msk_ray.experiment.manifest import Experiment
from msk_ray.training.loggers.tensorboard import board_tag
from msk_ray.tune.hparams import FILE, METRICS


def read_plugin(folder: Path, tag: str) -> plugin_data_pb2.HParamsPluginData:
    events = EventAccumulator(str(folder)).Reload()
    content = events.SummaryMetadata(tag).plugin_data.content
    return plugin_data_pb2.HParamsPluginData.FromString(content)


def test_settings_and_scores_meet_in_a_trials_folder(sweep: Experiment) -> None:
    trial = sweep.trials()[3]
    folder = sweep.trial_folder(trial.id)
    session = read_plugin(folder, metadata.SESSION_START_INFO_TAG).session_start_info
    assert {name: value.number_value for name, value in session.hparams.items()} == {"seed": 1, "shac.actor_lr": 1e-4}
    shown = [info.name.tag for info in read_plugin(folder, metadata.EXPERIMENT_TAG).experiment.metric_infos]
    assert shown == list(METRICS)
    scalars = EventAccumulator(str(folder)).Reload().Tags()["scalars"]
    assert set(METRICS) <= set(scalars), "every figure of the table is one that trials write"
    assert board_tag("env_steps") in METRICS
    # The file of settings comes first, whatever the names of the others: TensorBoard then follows those.
    first, *scalar_files = sorted(folder.glob("events*"))
    assert first.name == FILE
    assert len(scalar_files) == 1
