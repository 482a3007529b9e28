"""Film strips of episodes, and grids of them over training."""

from pathlib import Path

import numpy as np
from PIL import Image

from msk_ray.evaluate.measure import Bench, Request
from msk_ray.experiment.layout import best_checkpoint_in
from msk_ray.training import load_policy
from msk_ray.training.checkpoint import milestones
from msk_ray.visualize.film import grid
from msk_ray.visualize.recording import Recording, record
from msk_ray.visualize.render import View, frames


def episode_frames(recording: Recording, count: int, view: View) -> tuple[list[np.ndarray], list[str]]:
    """`count` frames of the first episode at equal times, from its first state to its last, and their times as text.

    Raises:
        DeviceError: no OpenGL platform works here.
    """
    states = recording.world(0)
    indices = _spread(len(states), count)
    return list(frames(states.at(indices), view)), _times(indices, recording)


def progression(
    bench: Bench, trial: Path, request: Request, count: int, view: View
) -> tuple[Image.Image | None, list[str]]:
    """A row of `count` frames for each policy that a trial saved during training, and for its best.

    All rows show the same times, chosen for the longest episode; a row ends where its episode does.

    Returns:
        The picture, or None if the trial saved no such policies, and the title of each row.

    Raises:
        CheckpointError: a policy file is incomplete. DeviceError: no OpenGL platform works here.
    """
    folder = trial / "checkpoints"
    paths = [path for _, path in milestones(folder)]
    if not paths:
        return None, []
    best = best_checkpoint_in(trial)
    policies = [load_policy(path) for path in paths]
    if best.is_file():
        policies.append(load_policy(best))
    recordings = [record(bench, policy, request) for policy in policies]
    indices = _spread(max(recording.length(0) for recording in recordings) + 1, count)
    rows, captions, titles = [], [], []
    for policy, recording in zip(policies, recordings, strict=True):
        shown = indices[indices <= recording.length(0)]
        rows.append(list(frames(recording.world(0).at(shown), view)))
        captions.append(_times(shown, recording))
        name = "best, " if policy.path == best else ""
        ending = recording.ending(0)
        titles.append(
            f"{name}epoch {policy.epoch}: score {float(recording.episodes.score[0]):.4g}"
            + (f", {ending} after {recording.length(0) * recording.timestep:.1f} s" if ending != "time" else "")
        )
    return grid(rows, titles, captions), titles


def _spread(length: int, count: int) -> np.ndarray:
    """`count` evenly spaced indices from 0 to length - 1; all of them if there are fewer."""
    return np.unique(np.round(np.linspace(0, length - 1, count)).astype(int))


def _times(indices: np.ndarray, recording: Recording) -> list[str]:
    return [f"{index * recording.timestep:.2f} s" for index in indices]
