"""How trials and drivers end: exits and errors of a trial's own code, and signals at moments of their own."""

import random
import signal
import time
from collections.abc import Callable
from pathlib import Path

from fault_campaign.reference import Reference
from fault_campaign.space import EPOCHS
from fault_campaign.sweep import Sweep
from fault_campaign.tally import RESUMABLE, Tally, judge, strike
from msk_ray.experiment.outcomes import read_ending
from msk_ray.experiment.trial import Trial

INTERRUPTED = 130
ERRORS = 1
NAMES = {
    "exit 3": "sys.exit(3) was called",
    "exit 0": "sys.exit(0) was called",
    "interrupt": "KeyboardInterrupt",
    "bug": "ValueError: made up",
    "infinite": "eval/score is inf at epoch",
}
"""What the reason of the ending begins with."""
ROUNDS = 3


def own_code(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """Trials' own code exits and raises: each trial ends at once, by name, with its line."""
    sweep = Sweep("own_code", scratch, reference.trials)
    kinds = list(zip(sweep.trials, ["exit 3", "exit 0", "interrupt", "bug"], strict=True))
    for trial, kind in kinds:
        sweep.plant(trial, dict.fromkeys(sorted(rng.sample(range(2, EPOCHS + 1), ROUNDS)), kind))
    wrong = _repeatedly(sweep, [(trial, NAMES[kind], ERRORS) for trial, kind in kinds], "error")
    tallies = []
    for trial, kind in kinds:
        tallies.append(
            judge(reference, sweep, f"own code: {kind}", sweep.struck(trial), "--resume --retry error", [trial])
        )
        tallies[-1].notes += [note for note in wrong if note.startswith(trial.id)]
    return tallies


def infinite(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """A score is infinite: the trial ends there, named like NaN."""
    sweep = Sweep("infinite", scratch, reference.trials)
    for trial in sweep.trials:
        sweep.plant(trial, {rng.randrange(2, EPOCHS + 1, 2): "infinite"})  # epochs that are evaluated
    wrong = _repeatedly(sweep, [(trial, NAMES["infinite"], 0) for trial in sweep.trials], "nonfinite", 1)
    tally = judge(
        reference, sweep, "infinite score", sum(map(sweep.struck, sweep.trials)), "--resume --retry nonfinite"
    )
    tally.notes += wrong
    return [tally]


def _repeatedly(sweep: Sweep, expected: list[tuple[Trial, str, int]], outcome: str, rounds: int = ROUNDS) -> list[str]:
    """Launch until no fault is left. Returns what was named in another way, or ended with another exit code."""
    notes = []
    for index in range(rounds):
        sweep.launch(*(["--retry", outcome] if index else []))
        code = sweep.wait()
        for trial, name, wanted in expected:
            ending = read_ending(sweep.path / "trials" / trial.id)
            if ending is None or ending.outcome != outcome or not ending.why.startswith(name):
                notes.append(f"{trial.id}: ended {ending} instead of {outcome}, {name}")
            if code != wanted:
                notes.append(f"{trial.id}: exit code {code} instead of {wanted}")
    sweep.launch("--retry", outcome)
    sweep.wait()
    return notes


def broken_connection(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """An error of the machine in a trial's process: another one takes its place."""
    sweep = Sweep("broken_connection", scratch, reference.trials)
    for trial in sweep.trials:
        sweep.plant(trial, dict.fromkeys(rng.sample(range(2, EPOCHS + 1), 3), "broken connection"))
    sweep.launch()
    code = sweep.wait()
    tally = judge(reference, sweep, "broken connection", sum(map(sweep.struck, sweep.trials)), "nothing")
    if code:
        tally.notes.append(f"exit code {code}")
    return [tally]


def frozen_ray(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """gcs_server is stopped, and the driver is asked to end (every second time) or not."""
    sweep = Sweep("frozen_ray", scratch, reference.trials)
    asked = [True, False]

    def blow() -> int:
        sweep.send(signal.SIGSTOP, "gcs_server")
        return sweep.kill(signal.SIGTERM) if asked.pop(0) else sweep.kill(signal.SIGSTOP, "gcs_server")

    injected, codes = strike(sweep, rng, 2, blow)
    return [_with_codes(judge(reference, sweep, "gcs_server frozen", injected, "--resume"), codes, RESUMABLE)]


def twice(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """Ctrl-C twice: the driver ends at once, and leaves no process."""
    sweep = Sweep("twice", scratch, reference.trials)
    left = []

    def blow() -> int:
        sweep.send(signal.SIGINT)
        code = sweep.kill(signal.SIGINT) if sweep.wait_for_line("save themselves") else sweep.wait()
        left.extend(sweep.leftovers(0.0))
        return code

    injected, codes = strike(sweep, rng, 3, blow)
    tally = judge(reference, sweep, "SIGINT twice", injected, "--resume")
    if left:
        tally.notes.append(f"processes were there after the driver's end: {left}")
    # Trials may have saved themselves before the second one arrived.
    return [_with_codes(tally, codes, INTERRUPTED, RESUMABLE)]


def early(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """Signals to the whole group in the first seconds, until the first trials run."""
    sweep = Sweep("early", scratch, reference.trials)
    codes = []
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1) * 3:
        sweep.launch()
        # Most of them while Ray starts, the others while modules are imported.
        sweep.wait_until_it_listens()
        if rng.random() < 0.7 and not sweep.wait_for_line("starting Ray"):
            break
        time.sleep(rng.uniform(0.3, 4.0))
        codes.append(sweep.kill(number, group=True))
    sweep.launch()
    sweep.wait()
    tally = judge(reference, sweep, "signal while the sweep starts", len(codes), "--resume")
    return [_with_codes(tally, codes, RESUMABLE)]


def in_report(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """SIGTERM while the report is written."""
    sweep = Sweep("in_report", scratch, reference.trials)
    codes, notes = [], []
    for _ in range(3):
        sweep.launch()
        if not sweep.wait_for_line("writing the report"):
            break
        time.sleep(rng.uniform(0.0, 1.0))
        codes.append(sweep.kill(signal.SIGTERM))
        if (sweep.path / "owner.json").exists():
            notes.append("owner.json was left")
    sweep.launch()
    sweep.wait()
    tally = judge(reference, sweep, "SIGTERM while the report is written", len(codes), "--resume")
    tally.notes += notes
    return [_with_codes(tally, codes, RESUMABLE)]


def _with_codes(tally: Tally, codes: list[int], *expected: int) -> Tally:
    if not set(codes) <= set(expected):
        tally.notes.append(f"exit codes {codes} instead of {expected}")
    return tally


CAMPAIGNS: dict[str, Callable[[Reference, Path, random.Random], list[Tally]]] = {
    "own_code": own_code,
    "infinite": infinite,
    "connection": broken_connection,
    "frozen_ray": frozen_ray,
    "twice": twice,
    "early": early,
    "report": in_report,
}
