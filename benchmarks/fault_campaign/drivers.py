"""Faults around processes: two drivers, one that is frozen, signals to the whole group, memory that has a limit."""

import random
import signal
import time
from collections.abc import Callable
from pathlib import Path

from fault_campaign.reference import Reference
from fault_campaign.space import EPOCHS, HANG_S
from fault_campaign.sweep import Sweep
from fault_campaign.tally import RESUMABLE, Tally, judge, strike

REFUSED = 2


def second_driver(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """`--resume` beside a driver at work is refused."""
    sweep = Sweep("second_driver", scratch, reference.trials)
    total = len(sweep.trials) * (EPOCHS + 1)
    injected, notes = 0, []
    sweep.launch()
    for share in (0.1, 0.3):
        if not sweep.wait_for_rows(round(total * (share + rng.uniform(0.0, 0.1)))):
            break
        code = sweep.beside()
        injected += 1
        if code != REFUSED:
            notes.append(f"exit code {code} instead of {REFUSED}")
    if code := sweep.wait():
        notes.append(f"the first driver ended with {code}")
    tally = judge(reference, sweep, "second driver beside the first", injected, "nothing: refused")
    tally.notes += notes
    return [tally]


def taken_over(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """`--resume --force` takes the experiment over from a driver at work, which stops.

    Early: the second driver needs seconds to start, and must not find that the first has ended meanwhile.
    """
    sweep = Sweep("taken_over", scratch, reference.trials)
    total = len(sweep.trials) * (EPOCHS + 1)
    injected, notes = 0, []
    sweep.launch()
    if sweep.wait_for_rows(round(total * rng.uniform(0.05, 0.15))):
        first = sweep.hand_over()
        injected += 1
        if first != RESUMABLE:
            notes.append(f"the first driver ended with {first} instead of {RESUMABLE}")
    if code := sweep.wait():
        notes.append(f"the second driver ended with {code}")
    fault = "experiment taken over from a driver at work"
    tally = judge(reference, sweep, fault, injected, "nothing: the new driver ends it")
    tally.notes += notes
    return [tally]


def frozen_driver(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """The driver is stopped for longer than a trial may be silent (a laptop asleep, SIGSTOP), and continues."""
    sweep = Sweep("frozen_driver", scratch, reference.trials)
    total = len(sweep.trials) * (EPOCHS + 1)
    tally = Tally("driver frozen for twice hang_s", 0, "nothing")
    sweep.launch()
    for share in (0.1, 0.5):
        if not sweep.wait_for_rows(round(total * (share + rng.uniform(0.0, 0.2)))):
            break
        sweep.send(signal.SIGSTOP)
        time.sleep(2 * HANG_S)
        sweep.send(signal.SIGCONT)
        tally.injected += 1
    code = sweep.wait()
    hung = [str(path) for path in sweep.path.glob("trials/*/hang.txt")]
    verdict = judge(reference, sweep, tally.fault, tally.injected, tally.ended_by)
    if code or hung:
        verdict.notes.append(f"exit code {code}; counted as hung: {hung or 'none'}")
    return [verdict]


def group_signal(reference: Reference, scratch: Path, rng: random.Random, number: signal.Signals) -> list[Tally]:
    """A signal reaches the driver, Ray's daemons and every trial, as from `timeout`, systemd or `kill -- -PGID`."""
    sweep = Sweep(f"group_{number.name}", scratch, reference.trials)
    injected, codes = strike(sweep, rng, 3, lambda: sweep.kill(number, group=True))
    tally = judge(reference, sweep, f"{number.name} to the whole group", injected, "--resume")
    if set(codes) != {RESUMABLE}:
        tally.notes.append(f"exit codes {codes} instead of {RESUMABLE}")
    return [tally]


def memory_limit(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """A trial's process may have no more memory than it has (RLIMIT_AS): the next large allocation fails.

    The trial restarts with half its worlds; the others are not affected. Its results differ from the reference, so only
    its ending is judged.
    """
    sweep = Sweep("memory_limit", scratch, reference.trials)
    struck = sweep.trials[rng.randrange(len(sweep.trials))]
    sweep.plant(struck, {rng.randrange(4, EPOCHS): "memory"})
    sweep.launch("--halve-worlds")
    code = sweep.wait()
    others = [trial for trial in sweep.trials if trial is not struck]
    tally = judge(reference, sweep, "process at its memory limit", sweep.struck(struck), "half the worlds", others)
    halved = (sweep.path / "trials" / struck.id / "halved.json").is_file()
    ended = sweep.ending(struck)
    if code or not halved or ended != "finished":
        tally.notes.append(f"exit code {code}; halved: {halved}; {struck.id} ended {ended}")
    return [tally]


CAMPAIGNS: dict[str, Callable[[Reference, Path, random.Random], list[Tally]]] = {
    "second_driver": second_driver,
    "taken_over": taken_over,
    "frozen": frozen_driver,
    "group_sigterm": lambda *a: group_signal(*a, signal.SIGTERM),
    "group_sigusr1": lambda *a: group_signal(*a, signal.SIGUSR1),
    "memory": memory_limit,
}
