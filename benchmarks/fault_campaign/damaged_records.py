"""Files of a finished experiment are damaged one at a time: what is whole is still shown, what is not is named."""

import contextlib
import io
import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from fault_campaign.reference import Reference
from fault_campaign.space import EPOCHS
from fault_campaign.tally import Tally
from msk_ray.cli import run
from msk_ray.config import dump_yaml
from msk_ray.experiment import layout
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.outcomes import Ending, Outcome, write_ending
from msk_ray.experiment.records import read_records
from msk_ray.files import write_json
from msk_ray.report.reading import read_experiment
from msk_ray.status import main as status
from msk_ray.sweep import opening
from msk_ray.sweep.space import load_space

OF_A_TRIAL = (layout.METRICS_FILE, layout.OUTCOME_FILE, layout.DEVICE_FILE, layout.ATTEMPT_FILE, "config.yaml")
OF_THE_EXPERIMENT = (layout.MANIFEST_FILE, layout.ENVIRONMENT_FILE, layout.SPACE_FILE, layout.SUMMARY_FILE)
ODD = (b"", b"null", b"7", b"[]", b"{}", b"\xff\xfe", bytes(64), b"[" * 9999, b'{"epoch": 1e400}', b'{"epoch": 1')
TIMES = 3
"""Each kind of damage to each file."""


def _flip(data: bytes, rng: random.Random) -> bytes:
    damaged = bytearray(data)
    damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def _odd_line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    lines.insert(rng.randrange(len(lines)), rng.choice(ODD))
    return b"\n".join(lines)


KINDS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "a bit flipped": _flip,
    "cut": lambda data, rng: data[: rng.randrange(len(data))],
    "zeroed": lambda data, rng: bytes(len(data)),
    "a line of something else": _odd_line,
    "replaced by something else": lambda data, rng: rng.choice(ODD),
}


def damaged_records(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """Status, report and tables of experiments with one damaged file each."""
    whole = _experiment(reference, scratch)
    tallies = []
    for kind, damage in KINDS.items():
        tally, started = Tally(f"a record damaged: {kind}", 0, "nothing"), time.monotonic()
        for name in (*OF_A_TRIAL, *OF_THE_EXPERIMENT) * TIMES:
            made = Experiment(Path(shutil.copytree(whole.path, scratch / "damaged" / "e")))
            victim = rng.choice(reference.trials).id
            path = (made.trial_folder(victim) if name in OF_A_TRIAL else made.path) / name
            path.write_bytes(damage(path.read_bytes(), rng))
            tally.injected += 1
            try:
                rows, trials, note = _lost(made, victim, name)
            except Exception as error:  # a traceback is what must not be
                rows, trials, note = 0, 1, repr(error)
            tally.lost_rows += rows
            tally.lost_trials += trials
            if note:
                tally.notes.append(f"{name}: {note}")
            shutil.rmtree(made.path)
        tally.seconds = time.monotonic() - started
        tallies.append(tally)
    return tallies


def _experiment(reference: Reference, scratch: Path) -> Experiment:
    """The reference's trials as an experiment leaves them."""
    made = opening.create(scratch / "records", load_space(scratch / "space.yaml"), reference.trials, {})
    for trial in reference.trials:
        folder = made.trial_folder(trial.id)
        folder.mkdir()
        shutil.copy(reference.folder_of(trial) / layout.METRICS_FILE, folder)
        (folder / "config.yaml").write_text(dump_yaml(trial.config.as_dict()))
        write_json(folder / layout.DEVICE_FILE, {"host": "h", "visible": "", "count": 0, "name": "cpu"})
        halved = {"asked": 8, "worlds": 4, "why": "for the sake of damage", "cleared": True}
        write_json(folder / layout.ATTEMPT_FILE, halved)
        write_ending(folder, Ending(Outcome.FINISHED, f"all {EPOCHS} epochs done"))
    write_json(made.path / layout.SUMMARY_FILE, {})
    return made


def _lost(made: Experiment, victim: str, name: str) -> tuple[int, int, str]:
    """Whole rows and whole trials that are no longer shown, and what else is wrong."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run(status, [str(made.path)])
    note = "" if code in (0, 2) and err.getvalue().count("\n") <= 1 else f"status ended with {code}: {err.getvalue()}"
    reading = read_experiment(made, time.time())
    trials = {trial.trial.id: trial for trial in reading.trials}
    if name == layout.MANIFEST_FILE:
        missing = 0 if code == 2 or len(trials) == 4 else 4 - len(trials)  # refused, or shown
        return 0, missing, note
    if code:
        note = f"status refused: {err.getvalue()}"
    read_records(made)
    others = [trial for trial in trials.values() if trial.trial.id != victim]
    lost_trials = sum(len(trial.columns.get("epoch", ())) != EPOCHS + 1 or trial.note != "" for trial in others)
    lost_trials += 4 - len(trials)
    lines = (made.trial_folder(victim) / layout.METRICS_FILE).read_bytes().split(b"\n")
    whole = (made.path.parent.parent / "records" / "trials" / victim / layout.METRICS_FILE).read_bytes().split(b"\n")
    kept = sum(line in whole for line in set(lines) - {b""})
    return max(0, kept - len(read_rows(made.trial_folder(victim)))), lost_trials, note
