"""`python -m msk_ray.evaluate`: deterministic evaluation on fixed seeds."""

import argparse
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msk_ray.cli import STORAGE, Parser, positive, run
from msk_ray.compiling import announce_compiling
from msk_ray.config import RandomizeConfig
from msk_ray.errors import CheckpointError, ConfigError, MskRayError
from msk_ray.evaluate import zoo
from msk_ray.evaluate.foreign_scoring import SCORINGS, Scorer, find_python, foreign_scoring
from msk_ray.evaluate.stored import FORMAT, eval_file_of, store_evaluation
from msk_ray.evaluate.targets import REFERENCE, Kind, Target, best_of_trial, checkpoint_of, find_target
from msk_ray.evaluate.vary import HELP, parse_vary, vary_text
from msk_ray.experiment.attempts import read_attempt
from msk_ray.experiment.checkpoint_format import read_facts
from msk_ray.experiment.layout import EVAL_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.trial import by_environment
from msk_ray.files import write_json
from msk_ray.shipped import is_shipped
from msk_ray.sweep.space import parse_seeds
from msk_ray.text import printable
from msk_ray.text_table import text_table

if TYPE_CHECKING:
    from msk_ray.evaluate.measure import Request

DESCRIPTION = """\
Evaluate a policy: without noise, from fixed initial states, under the environment's default reward weights.

Prints score, speed, falls, episode length and every reward term with its spread over episodes, and stores them in the
trial's eval.json (for the policies in policies/ it only prints). For an experiment it evaluates the best policy of each
trial, ranks the trials, and writes the ranking to the experiment's eval.json. Without options it repeats the evaluation
that gave eval/score, by which trials are ranked; on the same device, every digit is the same. For policies/, or another
folder that export --zoo wrote, it repeats the recorded evaluation of each policy and prints the table of its README."""

EXAMPLES = """\
  python -m msk_ray.evaluate runs/demo                                   # every trial's best policy, ranked
  python -m msk_ray.evaluate runs/demo/trials/1a2b3c4d                   # that trial's best policy
  python -m msk_ray.evaluate runs/demo/trials/1a2b3c4d/checkpoints/epoch_000100.pt
  python -m msk_ray.evaluate ant_lr --physics reference,published,own    # how much of it is the physics?
  python -m msk_ray.evaluate ant_lr --worlds 256 --seeds 0-4             # fresh initial states
  python -m msk_ray.evaluate runs/mine --vary body_mass=0.8x,1.2x        # how well does it work with other masses?
  python -m msk_ray.evaluate runs/train/myoleg26_seed0 --with push,uphill,rough,weak   # how robust is it?
  python -m msk_ray.evaluate runs/mine --with disturbed                  # under the noise and pushes of its training
  python -m msk_ray.evaluate runs/train/myosuite_walk_seed0 --in myosuite   # in MyoSuite's own environment
  python -m msk_ray.evaluate policies/                                   # do the trained policies score as recorded?

exit codes: 0 done, 1 a policy could not be evaluated, or a zoo's score does not agree with the record, 2 refused."""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.evaluate", DESCRIPTION, EXAMPLES)
    p.add_argument(
        "target", metavar="CHECKPOINT|TRIAL|EXPERIMENT|ZOO", help="a .pt file, a folder, or an experiment's name"
    )
    p.add_argument("--worlds", type=positive, metavar="W", help="episodes per seed (default: the trial's, 64)")
    p.add_argument("--seeds", metavar="LIST", help="seeds of the initial states, such as 0-4 (default: the trial's)")
    p.add_argument("--steps", type=positive, metavar="N", help="maximum env steps per episode")
    p.add_argument(
        "--physics",
        metavar="LIST",
        help="comma-separated: reference (used for scores), own (used in training), or names from the environment "
        "(default: reference; if the environment names no physics, that is the same as own)",
    )
    p.add_argument("--vary", metavar="FIELD=LIST", help=HELP)
    p.add_argument(
        "--with",
        dest="conditions",
        metavar="LIST",
        help="comma-separated harder conditions, evaluated after the usual one: disturbed (by the trial's own "
        "physics.randomize); for legs also push and weak; for myoleg26 also uphill, downhill and rough",
    )
    p.add_argument(
        "--in",
        dest="elsewhere",
        metavar="NAME",
        help="evaluate in another package's unmodified environment, which runs in its own Python: "
        + "; ".join(foreign_scoring(name).summary for name in SCORINGS.known()),
    )
    p.add_argument(
        "--python",
        type=Path,
        metavar="FILE",
        help="with --in: the Python that has the package (default: "
        + ", ".join(f"{foreign_scoring(name).python}" for name in SCORINGS.known())
        + ")",
    )
    p.add_argument(
        "--device", help="cpu or cuda:N (default: the first GPU, or the CPU if there is none); --in has its own"
    )
    p.add_argument("--storage", **STORAGE)
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    target = find_target(args.target, args.storage)
    seeds = parse_seeds(args.seeds) if args.seeds is not None else None
    variations = parse_vary(args.vary) if args.vary is not None else []
    python = _foreign_python(args)
    if args.vary is not None and args.conditions is not None:
        raise ConfigError("--with: conditions need the unchanged model; leave --vary out")
    if target.kind is Kind.ZOO:
        return _evaluate_zoo(target, args)
    if target.kind is not Kind.EXPERIMENT:
        checkpoint_of(target)  # torch and Warp take seconds to load; a wrong path should not wait for them
    announce_compiling(f"evaluating {_description(target)}")

    from msk_ray.evaluate import measure

    scorer: Scorer
    requests: Sequence[Request]
    if python is not None:
        scorer = foreign = foreign_scoring(args.elsewhere).scorer(python)
        requests, group_size = foreign.requests(args.worlds, seeds, args.steps), 1
    else:
        from msk_ray.step.autograd.simulation import resolve_device

        device = args.device or measure.default_device()
        resolve_device(device)  # a missing device is not the fault of any trial
        scorer = measure.Bench(device, tell=True)
        requests, group_size = _requests(args, seeds, variations)
    if target.kind is Kind.EXPERIMENT:
        return evaluate_experiment(Experiment(target.path), scorer, requests)
    return _evaluate_one(target, scorer, requests, group_size)


def _requests(
    args: argparse.Namespace, seeds: tuple[int, ...] | None, variations: Sequence[RandomizeConfig]
) -> "tuple[list[Request], int]":
    """The requests for each physics: as usual, then with each variation or under each condition.

    Returns:
        The requests, and how many successive ones have the same physics.
    """
    from msk_ray.evaluate.measure import Request

    physics = [name.strip() for name in (args.physics or REFERENCE).split(",")]
    sizes = args.worlds, seeds, args.steps
    if args.conditions is None:
        varied = [None, *variations]
        return [Request(name, *sizes, variation) for name in physics for variation in varied], len(varied)
    conditions = [None, *(condition.strip() for condition in args.conditions.split(","))]
    return [Request(name, *sizes, condition=c) for name in physics for c in conditions], len(conditions)


def _evaluate_zoo(target: Target, args: argparse.Namespace) -> int:
    """Evaluate the policies of a zoo, each as its entry says."""
    for option in ("worlds", "seeds", "steps", "physics", "vary", "conditions", "elsewhere", "python"):
        if getattr(args, option) is not None:
            flag = {"elsewhere": "in", "conditions": "with"}.get(option, option)
            raise ConfigError(f"--{flag}: the policies of {target.path} are evaluated as recorded there; leave it out")
    zoo.read_zoo(target.path)  # torch and Warp take seconds to load; a damaged entry should not wait for them
    announce_compiling(f"evaluating the policies of {target.path} as recorded there")

    from msk_ray.evaluate import measure
    from msk_ray.step.autograd.simulation import resolve_device

    device = args.device or measure.default_device()
    resolve_device(device)
    return zoo.evaluate_zoo(target.path, measure.Bench(device, tell=True))


def _description(target: Target) -> str:
    """What is evaluated, for the line that announces it."""
    if target.kind is not Kind.EXPERIMENT:
        return str(checkpoint_of(target))
    return f"the best policy of each of the {len(Experiment(target.path).trials())} trials of {target.path}"


def _foreign_python(args: argparse.Namespace) -> Path | None:
    """The interpreter in which the package that `--in` names runs; None without `--in`.

    Raises:
        ConfigError: there is no such interpreter, or an option does not go with `--in`.
    """
    if args.elsewhere is None:
        if args.python is not None:
            raise ConfigError("--python: only --in reads it; leave it out")
        return None
    for option in ("physics", "vary", "device", "conditions"):
        if getattr(args, option) is not None:
            flag = {"conditions": "with"}.get(option, option)
            raise ConfigError(f"--{flag}: --in {args.elsewhere} has its own physics and device; leave it out")
    return find_python(foreign_scoring(args.elsewhere), args.python)


def _evaluate_one(target: Target, scorer: Scorer, requests: "Sequence[Request]", group_size: int) -> int:
    """Evaluate one policy, and print one table for each group of successive requests."""
    from msk_ray.training import load_policy

    path = checkpoint_of(target)
    policy = load_policy(path)
    for request in requests:
        scorer.check(policy.config, request)
    entries = []
    for request in requests:
        entries.append(scorer.evaluate(policy, request))
        if not is_shipped(path):
            store_evaluation(eval_file_of(path), entries[-1])
        if group_size == 1:
            print(policy_text(entries[-1]) + "\n")
        elif len(entries) % group_size == 0:
            print(vary_text(entries[-group_size:]) + "\n")
    if not is_shipped(path):
        print(f"written into {eval_file_of(path)}")
    return 0


def policy_text(entry: dict[str, Any]) -> str:
    """An evaluation for a terminal."""
    seeds = ",".join(map(str, entry["seeds"]))
    rows = [
        (name, *(f"{values[part]:.5g}" for part in ("mean", "std", "min", "max")))
        for name, values in figure_rows(entry)
    ]
    shares = [f"{name} {entry[key]:.1%}" for key, name in SHARES.items() if key in entry]
    epoch = f"epoch {entry['epoch']}" + (" (untrained)" if entry["epoch"] == 0 else "")
    return (
        f"{entry['checkpoint']}, {epoch}, under {entry['physics']} physics: {entry['worlds']} worlds, "
        f"seeds {seeds}, {entry['steps']} steps, on {entry['device']}\n"
        + text_table(("per episode", "mean", "std", "min", "max"), rows, 120)
        + "\n"
        + " · ".join(shares)
    )


SHARES = {"fall_rate": "fell", "diverged_rate": "diverged", "success_rate": "succeeded"}


def figure_rows(entry: dict[str, Any]) -> list[tuple[str, dict[str, float]]]:
    """Names and values of an evaluation's score, length, outcome terms such as the speed, and reward terms."""
    return [
        ("score", entry["score"]),
        ("length", entry["length"]),
        *entry["outcomes"].items(),
        *((f"term/{name}", values) for name, values in entry["terms"].items()),
    ]


def evaluate_experiment(experiment: Experiment, scorer: Scorer, requests: "Sequence[Request]") -> int:
    """Evaluate the best policy of each trial, store the results in its folder, and rank the trials of each
    environment.

    A trial whose policy cannot be evaluated, or that has only its untrained policy, is listed without a rank and does
    not stop the others.

    Returns:
        The exit code: 1 if a policy could not be evaluated.

    Raises:
        CheckpointError: no policy could be evaluated.
    """
    groups = by_environment(experiment.trials(), lambda trial: trial.environment)
    for request in requests:
        for group in groups.values():
            scorer.check(group[0].config, request)
    results = _evaluate_trials(experiment, scorer, requests)
    if not results.rankings:
        why = next(iter([*results.failed.values(), *results.untrained.values()]), "it has no trials")
        raise CheckpointError(f"no policy of {experiment.path} could be evaluated; the first: {why}")
    path = experiment.path / EVAL_FILE
    write_json(path, {"format": FORMAT, "experiment": experiment.name, **results.as_json()})
    width = max(100, shutil.get_terminal_size((160, 24)).columns)
    for (_, environment), entries in results.rankings.items():
        where = f"{printable(environment)} " if len(groups) > 1 else ""
        print(f"\n{where}under {entries[0]['physics']} physics\n{ranking_text(entries, width)}")
    print(f"\nwritten into {path}")
    return 1 if results.failed else 0


@dataclass(frozen=True)
class _ExperimentResults:
    """Results of the best policies of an experiment."""

    rankings: dict[tuple[int, str], list[dict[str, Any]]] = field(default_factory=dict)
    """Entries of `eval.json`, best first, by number of the request and environment."""
    failed: dict[str, str] = field(default_factory=dict)
    """Why a policy could not be evaluated, by trial."""
    untrained: dict[str, str] = field(default_factory=dict)
    """A line for each trial that has only its untrained policy."""

    def as_json(self) -> dict[str, Any]:
        """What `eval.json` says about them."""
        return {
            "rankings": [
                {"environment": environment, "physics": entries[0]["physics"], "ranking": entries}
                for (_, environment), entries in self.rankings.items()
            ],
            "failed": [{"trial": trial, "why": why} for trial, why in self.failed.items()],
            "untrained": sorted(self.untrained),
        }


def _evaluate_trials(experiment: Experiment, scorer: Scorer, requests: "Sequence[Request]") -> _ExperimentResults:
    """Evaluate the best policy of each trial for each request, with a line of output for each."""
    from msk_ray.training import load_policy

    results = _ExperimentResults()
    trials = experiment.trials()
    for request_number, request in enumerate(requests):
        for number, trial in enumerate(trials, start=1):
            folder = experiment.trial_folder(trial.id)
            entry = None
            try:
                path = best_of_trial(folder)
                if read_facts(path).get("epoch") == 0:
                    outcome = results.untrained[trial.id] = f"{path} is the untrained policy; it has no rank"
                else:
                    entry = scorer.evaluate(load_policy(path), request)
                    store_evaluation(eval_file_of(path), entry)
                    outcome = f"{entry['score']['mean']:.5g}"
            except MskRayError as error:
                entry, outcome = None, printable(str(error))
                results.failed[trial.id] = str(error)
            if entry is not None:
                name = trial.variant + read_attempt(folder).suffix
                ranked = {"trial": trial.id, "variant": name, "seed": trial.seed, **entry}
                results.rankings.setdefault((request_number, trial.environment), []).append(ranked)
            print(f"{number}/{len(trials)}  {trial.id}  {outcome}", flush=True)
    for entries in results.rankings.values():
        entries.sort(key=lambda entry: -entry["score"]["mean"])
    return results


def ranking_text(ranking: Sequence[dict[str, Any]], width: int) -> str:
    """A ranking for a terminal."""
    outcomes = list(ranking[0]["outcomes"])
    header = ("#", "trial", "score", "std", *outcomes, "length", "fell", "seed", "epoch", "changed")
    rows = [
        (
            str(place),
            entry["trial"],
            f"{entry['score']['mean']:.5g}",
            f"{entry['score']['std']:.3g}",
            *(f"{entry['outcomes'][name]['mean']:.3g}" if name in entry["outcomes"] else "-" for name in outcomes),
            f"{entry['length']['mean']:.0f}",
            f"{entry['fall_rate']:.0%}",
            str(entry["seed"]),
            str(entry["epoch"]),
            entry["variant"],
        )
        for place, entry in enumerate(ranking, start=1)
    ]
    return text_table(header, rows, width)


if __name__ == "__main__":
    sys.exit(run(main))
