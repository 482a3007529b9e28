"""What became of the sweeps that faults struck."""

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from fault_campaign.reference import Reference
from fault_campaign.space import EPOCHS
from fault_campaign.sweep import PATIENCE_S, Sweep
from msk_ray.experiment.trial import Trial

RESUMABLE = 75


@dataclass
class Tally:
    """One line of the table."""

    fault: str
    injected: int
    ended_by: str
    lost_rows: int = 0
    lost_trials: int = 0
    lost_policies: int = 0
    """Best policies that differ or are missing."""
    tracebacks: int = 0
    """In what the drivers printed."""
    codes: str = ""
    """Exit codes of the drivers, as often as they occurred."""
    seconds: float = 0.0
    notes: list[str] = field(default_factory=list)

    @property
    def survived(self) -> int:
        return 0 if self.lost_rows or self.lost_trials or self.lost_policies else self.injected


def strike(sweep: Sweep, rng: random.Random, times: int, blow: Callable[[], int]) -> tuple[int, list[int]]:
    """Launch, strike once some rows have been written, and again; at last let it end.

    Returns:
        How often it was struck before it had ended, and the exit codes of the drivers struck.
    """
    total = len(sweep.trials) * (EPOCHS + 1)
    codes: list[int] = []
    for index in range(times):
        sweep.launch()
        # Spread over the sweep, each share of it drawn on; rows not yet checkpointed are written again.
        share = total * (index + rng.uniform(0.3, 0.9)) / (times + 0.5)
        if not sweep.wait_for_rows(round(share)):
            break
        codes.append(blow())
        print(f"  {sweep.name}: struck at about {share:.0f} of {total} rows, exit code {codes[-1]}", flush=True)
    sweep.launch()
    code = sweep.wait()
    if code:
        print(f"  {sweep.name}: the last resume ended with {code}", flush=True)
    return len(codes), codes


def judge(
    reference: Reference, sweep: Sweep, fault: str, injected: int, ended_by: str, trials: list[Trial] | None = None
) -> Tally:
    """Compare a sweep that has been brought to its end with trials that were left alone."""
    lost, notes = reference.compare(sweep.path, trials or sweep.trials)
    left = sweep.leftovers()
    if left:
        notes.append(f"processes of killed drivers were still there {PATIENCE_S:.0f} s later: {', '.join(left)}")
    tracebacks = sweep.tracebacks()
    if tracebacks:
        notes.append(f"{tracebacks} tracebacks on the terminal")
    codes = ", ".join(f"{code} ({times})" for code, times in sorted(Counter(sweep.codes).items()))
    return Tally(
        fault, injected, ended_by, lost.rows, lost.trials, lost.policies, tracebacks, codes, sweep.seconds, notes
    )
