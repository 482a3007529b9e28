"""What would early stopping have done? A sweep that ran without it is judged afterwards by a space's rule.

The recorded evaluations are replayed to the rule in the order in which a given number of trials at a time would have
reached them; a trial that the rule names ends there, and the next one starts. The table shows what that saves and what
it costs: the best score kept, compared with the best of all. Which trials meet at a rung depends on the order in which
they start, so the rule is also judged over random orders. A sweep that was itself stopped early cannot be judged,
because the final scores of its trials are not known.
"""

import argparse
import heapq
import random
import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError
from record import RESULTS, markdown_table, publish

from msk_ray.cli import run
from msk_ray.config import describe_fault
from msk_ray.errors import ConfigError
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import Evaluation
from msk_ray.experiment.outcomes import Outcome
from msk_ray.experiment.records import TrialRecord, read_records
from msk_ray.experiment.results_table import outcome_name
from msk_ray.sweep.rules.asha import Asha
from msk_ray.sweep.rules.median import Median
from msk_ray.sweep.rules.scheduler import Pruner, SchedulerSpec, refuse_several

NEAR = 0.01
"""Share of its best score that a sweep may lose and still count as equally good."""


@dataclass(frozen=True)
class Judged:
    """A trial as early stopping would have left it."""

    record: TrialRecord
    last: Evaluation
    """Where it ended."""
    stopped: bool

    @property
    def best(self) -> float:
        """Its best score up to there."""
        return max(e.score for e in self.record.evaluations if e.epoch <= self.last.epoch)


@dataclass(frozen=True)
class Rule:
    """The rule of a space's scheduler, for trials of which the longest takes `budget`."""

    spec: SchedulerSpec
    budget: float

    def fresh(self) -> Pruner:
        """The rule, without any evaluations yet."""
        return self.spec.pruner(self.budget)


def judge(records: Sequence[TrialRecord], pruner: Pruner, time_attr: str, slots: int) -> list[Judged]:
    """Replay the trials' evaluations to a rule, as if `slots` trials ran at a time, each at its own speed.

    Args:
        records: finished trials, in the order in which they start.
        pruner: the rule, without any evaluations yet.
        time_attr: the progress at which it compares trials.
        slots: number of trials at a time.
    """
    waiting = deque(range(len(records)))
    reports = [record.evaluations for record in records]
    judged: dict[int, Judged] = {}
    # Next evaluation of each running trial: its time, the trial, its number, and the trial's start time.
    running: list[tuple[float, int, int, float]] = []

    def begin(now: float) -> None:
        if waiting:
            trial = waiting.popleft()
            heapq.heappush(running, (now + reports[trial][0].seconds, trial, 0, now))

    for _ in range(slots):
        begin(0.0)
    while running:
        now, trial, count, began = heapq.heappop(running)
        report, ended = reports[trial][count], count + 1 == len(reports[trial])
        stop = pruner.report(records[trial].trial.id, report.time(time_attr), report.score) is not None and not ended
        if stop or ended:
            judged[trial] = Judged(records[trial], report, stop)
            begin(now)
        else:
            heapq.heappush(running, (began + reports[trial][count + 1].seconds, trial, count + 1, began))
    return [judged[trial] for trial in range(len(records))]


def table(judged: Sequence[Judged]) -> str:
    """One row per trial, the best first, and what was saved."""
    rows = []
    for one in sorted(judged, key=lambda j: -_whole(j)):
        trial = one.record.trial
        end = f"stopped at {one.last.epoch} of {trial.config.trial.epochs}" if one.stopped else "kept"
        rows.append([trial.variant, str(trial.seed), f"{_whole(one):.5g}", f"{one.best:.5g}", end])
    used, epochs_used = sum(j.last.env_steps for j in judged), sum(j.last.epoch for j in judged)
    whole = sum(j.record.evaluations[-1].env_steps for j in judged)
    epochs = sum(j.record.epochs_done for j in judged)
    best, kept = max(map(_whole, judged)), max(j.best for j in judged)
    verdict = "kept" if kept == best else f"LOST, {kept:.5g} instead"
    header = ["trial", "seed", "score without stopping", "score with it", "end"]
    return (
        markdown_table(header, rows)
        + f"\n\nSaved: {1 - used / whole:.0%} of the env steps, {1 - epochs_used / epochs:.0%} of the epochs. "
        + f"Best of all, {best:.5g}: {verdict}."
    )


@dataclass(frozen=True)
class Chances:
    """A rule over random orders of the trials."""

    orders: int
    kept: int
    """Number of orders in which the best trial reached its best score."""
    near: int
    """Number of orders that kept a score within NEAR of it: the best trial often has a twin."""
    mean_best: float
    """Best score that was kept, mean over orders."""
    saved: tuple[float, float, float]
    """Share of the env steps saved: smallest, mean, largest."""


def chances(records: Sequence[TrialRecord], rule: Rule, slots: int, orders: int) -> Chances:
    """Judge a rule over a number of random orders of the trials, the same ones in every call."""
    draw = random.Random(0)
    best = max(e.score for record in records for e in record.evaluations)
    whole = sum(record.evaluations[-1].env_steps for record in records)
    lefts, saved = [], []
    for _ in range(orders):
        judged = judge(draw.sample(records, len(records)), rule.fresh(), rule.spec.time_attr, slots)
        lefts.append(max(one.best for one in judged))
        saved.append(1 - sum(one.last.env_steps for one in judged) / whole)
    kept = sum(left == best for left in lefts)
    near = sum(left >= best - NEAR * abs(best) for left in lefts)
    return Chances(orders, kept, near, sum(lefts) / orders, (min(saved), sum(saved) / orders, max(saved)))


def choose(
    records: Sequence[TrialRecord], experiment: Path, leave_out: bool
) -> tuple[list[TrialRecord], list[TrialRecord]]:
    """Trials that ran to their end, and the others.

    Raises:
        ConfigError: there are others, and they should not be left out or were themselves stopped early: judging only
            the survivors of a rule would flatter any rule.
    """
    whole = [r for r in records if r.ending is not None and r.ending.outcome is Outcome.FINISHED]
    others = [r for r in records if r not in whole]
    stopped = [r for r in others if r.ending is not None and r.ending.cut]
    if whole and not stopped and (leave_out or not others):
        return whole, others
    example = "".join(f", {r.trial.id} for one ({outcome_name(r)})" for r in [*stopped, *others][:1])
    raise ConfigError(
        f"{experiment}: {len(others)} of {len(records)} trials did not run to their end{example}; judge a finished "
        "sweep that ran with --no-early-stopping" + (", or --leave-out-unfinished" if whole and not stopped else "")
    )


def _whole(one: Judged) -> float:
    return max(e.score for e in one.record.evaluations)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("experiment", type=Path, help="folder of a sweep that ran with --no-early-stopping")
    p.add_argument("--kind", choices=("asha", "median"), default="asha")
    p.add_argument("--grace", type=float, default=0.25, help="share of the budget within which no trial is stopped")
    p.add_argument("--reduction", type=float, default=3.0, help="asha: one trial in this many continues")
    p.add_argument("--slots", type=int, default=4, help="trials at once")
    p.add_argument("--orders", type=int, default=1000, help="number of random orders of the trials to judge too")
    p.add_argument("--leave-out-unfinished", action="store_true", help="leave out unfinished trials, and name them")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args(argv)
    if args.slots < 1 or args.orders < 1:
        raise ConfigError(f"--slots {args.slots} --orders {args.orders}: at least 1 of each")
    try:
        if args.kind == "asha":
            spec: SchedulerSpec = Asha(kind="asha", grace=args.grace, reduction=args.reduction)
        else:
            spec = Median(kind="median", grace=args.grace)
    except ValidationError as error:
        raise ConfigError(f"--{describe_fault(error, SchedulerSpec)}") from error
    experiment = Experiment(args.experiment.resolve())
    records = read_records(experiment)
    refuse_several((r.trial.environment for r in records), f"{args.experiment}: a rule compares trials by their scores")
    whole, others = choose(records, args.experiment, args.leave_out_unfinished)
    rule = Rule(spec, max(record.evaluations[-1].time(spec.time_attr) for record in whole))
    judged = judge(whole, rule.fresh(), spec.time_attr, args.slots)
    odds = chances(whole, rule, args.slots, args.orders)
    named = f"{args.kind}, grace {args.grace:g}" + (f", reduction {args.reduction:g}" if args.kind == "asha" else "")
    title = f"Early stopping of {args.experiment.name}, {named}, {args.slots} trials at once"
    ran_on = sorted({record.device.name for record in records} - {""})
    text = (
        f"{table(judged)}\n\nOver {odds.orders} random orders of the trials the best of all was kept in "
        f"{odds.kept / odds.orders:.0%}, and a score within {NEAR:.0%} of it in {odds.near / odds.orders:.0%}; the "
        f"best that was left has a mean of {odds.mean_best:.5g}; "
        f"{odds.saved[0]:.0%} to {odds.saved[2]:.0%} of the env steps were saved, {odds.saved[1]:.0%} on average.\n\n"
    )
    for record in others:
        best = "no score" if record.best is None else f"a best score of {record.best.score:.5g}"
        text += (
            f"Left out: {record.trial.variant}, seed {record.trial.seed}, {outcome_name(record)} at epoch "
            f"{record.epochs_done} of {record.trial.config.trial.epochs} with {best}. "
        )
    text += f"The sweep ran on: {', '.join(ran_on) or 'CPU'}; it is judged on the machine above."
    publish("early_stopping", title, "cpu", text, args.results)
    return 0


if __name__ == "__main__":
    sys.exit(run(main, sys.argv[1:]))
