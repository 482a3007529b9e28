"""Which faults a sweep survives: faults drawn from a fixed seed hit CartPole trials under Ray Tune, which are then
compared with undisturbed trials.

The reference is `Trainer` in a loop, without Ray. After its faults, every sweep is completed with `--resume` (if that
is needed). Then every trial must have finished, each row of the reference must be present exactly once with equal
values (except timings), and the last checkpoint and the best policy must hold equal tensors. Drivers print no
traceback, and end with the exit codes that docs/runner/faults.md promises.

Faults inside a trial's process happen once each, at a chosen epoch (`FaultyTrainer`); those from outside (driver,
raylet, files, disk) when the trials have written a number of rows drawn from the seed.
"""

import sys

if sys.argv[1:2] == ["drive"]:
    # Before the imports that take time to load, as `python -m msk_ray.tune` does.
    from msk_ray import signals

    signals.listen()

import argparse
import random
import time
from pathlib import Path

from fault_campaign import campaigns, drivers, endings, other_user
from fault_campaign.reference import Reference
from fault_campaign.space import EPOCHS, SPACE
from fault_campaign.sweep import scratch_folder
from fault_campaign.tally import Tally
from fault_campaign.trainer import drive
from record import RESULTS, markdown_table, publish

from msk_ray.config import dump_yaml
from msk_ray.sweep.space import load_space
from msk_ray.sweep.trials import resolve_trials

CAMPAIGNS = campaigns.CAMPAIGNS | drivers.CAMPAIGNS | endings.CAMPAIGNS | other_user.CAMPAIGNS


def main() -> int:
    """Run the campaign; 1 if anything was lost."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--seed", type=int, default=0, help="of when and where faults strike")
    p.add_argument("--only", nargs="+", choices=list(CAMPAIGNS), help="some of the campaign")
    p.add_argument("--keep", action="store_true", help="keep the experiments and logs")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    started = time.monotonic()
    tallies: list[Tally] = []
    with scratch_folder(args.keep) as scratch:
        (scratch / "space.yaml").write_text(dump_yaml(SPACE))
        trials = resolve_trials(load_space(scratch / "space.yaml"))
        reference = Reference(trials, scratch / "reference")
        print(f"reference: {len(trials)} trials in {time.monotonic() - started:.0f} s", flush=True)
        for name in args.only or CAMPAIGNS:
            # A separate seed, so that a part on its own repeats what it does in the whole campaign.
            found = CAMPAIGNS[name](reference, scratch, random.Random(f"{args.seed} {name}"))
            for tally in found:
                print(
                    f"{tally.fault}: survived {tally.survived} of {tally.injected}, {tally.seconds:.0f} s", flush=True
                )
                for note in tally.notes:
                    print(f"  {note}", flush=True)
            tallies += found
    losses = ("lost_rows", "lost_trials", "lost_policies", "tracebacks")
    header = ["fault", "injected", "survived", *(name.replace("_", " ") for name in losses), "exit codes", "sweep s"]
    header.append("ended by")
    counts = ("injected", "survived", *losses)
    cells = [
        [t.fault, *(f"{getattr(t, name)}" for name in counts), t.codes, f"{t.seconds:.0f}", t.ended_by] for t in tallies
    ]
    sums = [sum(getattr(t, name) for t in tallies) for name in counts]
    cells.append(["all", *map(str, sums), "", f"{time.monotonic() - started:.0f}", ""])
    title = f"Faults survived, {len(trials)} CartPole trials of {EPOCHS} epochs a sweep, seed {args.seed}"
    notes = [f"- {tally.fault}: {note}" for tally in tallies for note in tally.notes]
    publish(
        "faults",
        title,
        "cpu",
        "\n".join([markdown_table(header, cells), *([""] if notes else []), *notes]),
        args.results,
    )
    return 1 if notes or sums[0] != sums[1] else 0


if __name__ == "__main__":
    sys.exit(drive(sys.argv[2:]) if sys.argv[1:2] == ["drive"] else main())
