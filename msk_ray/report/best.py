"""The best policy of an experiment: its evaluation and its film strip, made once for each checkpoint and stored."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from PIL import Image, PngImagePlugin

from msk_ray.errors import MskRayError
from msk_ray.evaluate.stored import eval_file_of, read_evaluations, store_evaluation
from msk_ray.evaluate.targets import best_of_trial
from msk_ray.experiment.checkpoint_format import read_facts
from msk_ray.experiment.layout import EVAL_FILE
from msk_ray.experiment.records import TrialRecord
from msk_ray.files import read_file, write_bytes
from msk_ray.report.reading import explain

STRIP = "strip"
FRAMES = 8
_FRAME = (256, 192)
_STAMP = "checkpoint"
_LARGEST = 16 << 20
"""Maximum size of a strip [B]."""


@dataclass(frozen=True)
class Best:
    """What is known of the best trial's best policy."""

    trial: TrialRecord
    sha: str | None = None
    """Of the policy's checkpoint; None if there is none that can be read."""
    evaluations: tuple[Mapping[str, Any], ...] = ()
    """Its evaluations in `eval.json`, the canonical one first."""
    strip: Path | None = None
    strip_text: str = ""
    missing: tuple[str, ...] = field(default=())
    """What cannot be shown, and why."""


def look_at_best(trial: TrialRecord, folder: Path, prefix: str, make: bool, device: str | None) -> Best:
    """Gather the evaluation and the strip of a trial's best policy.

    Args:
        folder: folder of the report's pictures.
        prefix: prefix of the strip's file name.
        make: whether to evaluate and draw what is missing.
        device: device of the simulation; None: the first GPU, or the CPU.
    """
    best = stored_best(trial, [folder / f"{prefix}{STRIP}.png"])
    if best.sha is None:
        return best
    path, strip = best_of_trial(trial.folder), folder / f"{prefix}{STRIP}.png"
    missing = []
    if make:
        try:
            if not any(entry["canonical"] for entry in best.evaluations):
                _evaluate(path, device)
        except (MskRayError, OSError) as error:
            missing.append(f"It could not be evaluated: {explain(error)}.")
        try:
            if best.strip is None:
                _draw(path, strip, best.sha, device)
        except (MskRayError, OSError) as error:
            missing.append(f"Its film strip could not be drawn: {explain(error)}.")
        best = stored_best(trial, [strip])
    elif best.strip is None:
        missing.append("Its film strip has not been drawn yet: add --best always.")
    return replace(best, missing=(*best.missing, *missing))


def stored_best(trial: TrialRecord, strips: Sequence[Path]) -> Best:
    """What is stored about a trial's best policy.

    Args:
        strips: film strips; the one that shows this policy is used.
    """
    missing = []
    try:
        facts = read_facts(best_of_trial(trial.folder))
        sha = facts["sha256"]
    except (MskRayError, KeyError) as error:
        return Best(trial, missing=(f"There is no policy to look at: {explain(error)}.",))
    if facts.get("epoch") == 0:
        missing.append("No trained policy has a score yet: the following is about the untrained one.")
    entries: list[dict[str, Any]] = []
    try:
        entries = _of_checkpoint(read_evaluations(trial.folder / EVAL_FILE), sha)
    except MskRayError as error:
        missing.append(f"Its evaluations cannot be read: {explain(error)}.")
    for strip in strips:
        text = strip_text(strip, sha)
        if text is not None:
            return Best(trial, sha, tuple(entries), strip, text, tuple(missing))
    return Best(trial, sha, tuple(entries), missing=tuple(missing))


def strip_bytes(path: Path) -> bytes:
    """The content of a strip.

    Raises:
        UnusableFile: it is no regular file, or too large.
        OSError: it cannot be read.
    """
    return read_file(path, _LARGEST)


def strip_text(path: Path, sha: str) -> str | None:
    """Description of a strip; None if it is missing or shows another checkpoint than the one with this hash."""
    if not path.is_file():
        return None
    try:
        with Image.open(io.BytesIO(strip_bytes(path))) as image:
            facts = dict(image.info)
    except (OSError, ValueError, Image.DecompressionBombError):
        return None  # incomplete, or not written by us: it is drawn again
    return str(facts.get("Description", "")) if facts.get(_STAMP) == sha else None


def _of_checkpoint(entries: list[dict[str, Any]], sha: str) -> list[dict[str, Any]]:
    return sorted((e for e in entries if e["sha256"] == sha), key=lambda entry: not entry["canonical"])


def _evaluate(path: Path, device: str | None) -> None:
    from msk_ray.evaluate.measure import Bench, Request, default_device
    from msk_ray.training import load_policy

    policy = load_policy(path)
    print(f"evaluating {path} ...", flush=True)
    store_evaluation(eval_file_of(path), Bench(device or default_device()).evaluate(policy, Request()))


def _draw(path: Path, out: Path, sha: str, device: str | None) -> None:
    from msk_ray.evaluate.measure import Bench, Request, default_device
    from msk_ray.training import load_policy
    from msk_ray.visualize.film import strip
    from msk_ray.visualize.look import describe_groups, geom_groups
    from msk_ray.visualize.recording import record
    from msk_ray.visualize.render import View, headless_backend
    from msk_ray.visualize.strips import episode_frames

    headless_backend()
    policy = load_policy(path)
    print(f"drawing an episode of {path} ...", flush=True)
    recording = record(Bench(device or default_device()), policy, Request(worlds=1))
    frames, times = episode_frames(recording, FRAMES, View(*_FRAME))
    text = (
        f"{len(frames)} evenly spaced frames of one episode, under {recording.physics} physics: score "
        f"{float(recording.episodes.score[0]):.5g} in {recording.length(0) * recording.timestep:.1f} s, "
        f"ended by {recording.ending(0)}"
    )
    if drawn := describe_groups(geom_groups(recording.model)):
        text += f"; {drawn}"
    stamp = PngImagePlugin.PngInfo()
    stamp.add_text(_STAMP, sha)
    stamp.add_text("Description", text)
    image = strip(frames, times)
    buffer = io.BytesIO()
    image.save(buffer, "png", pnginfo=stamp)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(out, buffer.getvalue())
