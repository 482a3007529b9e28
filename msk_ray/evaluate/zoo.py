"""A zoo is a folder of trained policies: beside each NAME.pt, a NAME.yaml records its score, the seeds of that score,
and how it was trained."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import ValidationError

from msk_ray.config import describe_fault, read_yaml
from msk_ray.config.sections import Count, Fraction, NonNegative, Section, Whole
from msk_ray.errors import MskRayError, StorageError
from msk_ray.experiment.checkpoint_format import read_facts
from msk_ray.text import printable

if TYPE_CHECKING:
    from msk_ray.evaluate.measure import Bench

MAX_BYTES = 1_000_000
"""Largest policy [B]."""
BEST_EVALUATION = "the best evaluation"
"""How a trial's best.pt is chosen."""
BEGIN, END = "<!-- Begin of what `msk-ray export --zoo` writes. -->", "<!-- End. -->"
_AGREEMENT = 3.0
"""Scores on different machines may differ by this many standard errors: rounding differs, and episodes are chaotic."""


class Score(Section):
    """An evaluation without noise under the reference reward and physics."""

    mean: float
    std: NonNegative
    """Standard deviation over episodes."""
    by_seed: dict[int, float]
    """Mean for each seed of the initial states."""
    worlds: Count
    """Episodes for each seed."""
    steps: Count
    """Maximum env steps of an episode."""
    length: NonNegative
    """Mean env steps of an episode."""
    physics: str
    fell: Fraction
    """Share of the episodes that ended in a fall."""
    diverged: Fraction
    outcomes: dict[str, float]
    """Means over env steps, such as the speed `vx` [m/s]."""
    device: str

    @property
    def episodes(self) -> int:
        return self.worlds * len(self.by_seed)

    def agrees(self, other: "Score") -> bool:
        """Whether the means differ by no more than chance explains."""
        error = math.hypot(self.std / math.sqrt(self.episodes), other.std / math.sqrt(other.episodes))
        return abs(self.mean - other.mean) <= max(_AGREEMENT * error, 1e-4 * abs(self.mean))


class Training(Section):
    """Where a policy comes from."""

    command: str
    commit: str
    machine: str
    chosen: str = BEST_EVALUATION
    """How its checkpoint was chosen among those of the trial."""
    epoch: Count
    """Epoch of the policy."""
    epochs: Count
    """Epochs of the trial."""
    env_steps: Whole
    """Env steps up to the policy."""
    seconds: NonNegative | None = None
    """Training time up to the policy [s]; null: not recorded."""
    sha256: str
    """Hash of the trial's checkpoint that it was taken from."""


class Entry(Section):
    """The content of NAME.yaml."""

    format: Literal[1] = 1
    env: str
    sha256: str
    """Hash of the content of NAME.pt."""
    weights: Literal["float32", "float16"] = "float32"
    """How the weights are stored. They compute in float32; the score is of the stored weights."""
    score: Score
    trained: Training
    packages: dict[str, str]
    """Versions with which it was evaluated, without msk_ray, whose commit is in `trained`."""
    config: dict[str, Any]
    """Every setting of the trial."""


def read_entry(policy: Path) -> Entry:
    """What is recorded about a policy.

    Raises:
        StorageError: the file beside it is about another policy, or holds something else.
        ConfigError: it is missing or no YAML.
        CheckpointError: the policy is missing or incomplete.
    """
    path = policy.with_suffix(".yaml")
    try:
        entry = Entry.model_validate(read_yaml(path, number_keys=True))
    except ValidationError as error:
        raise StorageError(f"{path}: {describe_fault(error)}") from None
    if read_facts(policy).get("sha256") != entry.sha256:
        raise StorageError(f"{path} is about another policy than {policy.name}: write both again with export --zoo")
    return entry


def read_zoo(folder: Path) -> dict[str, Entry]:
    """The policies of a folder by name, sorted.

    Raises:
        StorageError, ConfigError, CheckpointError: as for `read_entry`, or there is none.
    """
    policies = sorted(folder.glob("*.pt"))
    if not policies:
        raise StorageError(f"{folder} holds no policies; msk-ray export TRIAL --zoo {folder / 'NAME'} writes one")
    return {path.stem: read_entry(path) for path in policies}


def score_of(result: Mapping[str, Any]) -> Score:
    """The score in an entry of `eval.json`."""
    return Score(
        mean=round(result["score"]["mean"], 4),
        std=round(result["score"]["std"], 4),
        by_seed={int(seed): round(mean, 4) for seed, mean in result["score_by_seed"].items()},
        worlds=result["worlds"],
        steps=result["steps"],
        length=round(result["length"]["mean"], 2),
        physics=result["physics"],
        fell=result["fall_rate"],
        diverged=result["diverged_rate"],
        outcomes={name: round(values["mean"], 5) for name, values in result["outcomes"].items()},
        device=result["device"],
    )


def zoo_table(entries: Mapping[str, Entry]) -> str:
    """The policies as a table in Markdown."""
    head = ("policy", "score", "episodes", "means", "fell", "env steps", "trained on", "commit")
    rows = [head, ("---", "---:", "---:", "---", "---:", "---:", "---", "---")]
    for name, entry in entries.items():
        score, trained = entry.score, entry.trained
        seconds = "" if trained.seconds is None else f", {trained.seconds:.0f} s"
        rows.append(
            (
                f"`{name}.pt`",
                f"{score.mean:.5g} ± {score.std:.3g}",
                f"{len(score.by_seed)} × {score.worlds}",
                ", ".join(f"{key} {value:.3g}" for key, value in score.outcomes.items()) or "–",
                f"{score.fell:.0%}",
                f"{trained.env_steps:,}",
                f"{trained.machine}{seconds}",
                trained.commit[:7] + ("+" if trained.commit.endswith("+") else ""),
            )
        )
    return "\n".join("| " + " | ".join(map(printable, row)) + " |" for row in rows)


def zoo_text(entries: Mapping[str, Entry]) -> str:
    """The part of a zoo's README about its policies: a table, and the command of each."""
    commands = [
        f"- `{name}`: `{printable(entry.trained.command)}`; {printable(entry.trained.chosen)} (epoch "
        f"{entry.trained.epoch} of {entry.trained.epochs})"
        + ("" if entry.weights == "float32" else f"; weights stored as {entry.weights}")
        + f"; scored on {printable(entry.score.device)} under {printable(entry.score.physics)} physics"
        for name, entry in entries.items()
    ]
    return "\n".join([zoo_table(entries), "", *commands])


def evaluate_zoo(folder: Path, bench: "Bench") -> int:
    """Evaluate every policy of a zoo as its entry says, and print the table with these scores.

    Returns:
        The exit code: 1 if a policy could not be evaluated, or its score does not agree with the recorded one.
    """
    from msk_ray.evaluate.measure import Request
    from msk_ray.training import load_policy

    evaluated: dict[str, Entry] = {}
    code = 0
    for name, entry in read_zoo(folder).items():
        recorded = entry.score
        print(f"{name}: {recorded.episodes} episodes of up to {recorded.steps} env steps ...", flush=True)
        request = Request(worlds=recorded.worlds, seeds=tuple(recorded.by_seed), steps=recorded.steps)
        try:
            score = score_of(bench.evaluate(load_policy(folder / f"{name}.pt"), request))
        except MskRayError as error:
            print(f"{name}: {printable(str(error))}", flush=True)
            code = 1
            continue
        evaluated[name] = entry.model_copy(update={"score": score})
        same = score.model_dump(exclude={"device"}) == recorded.model_dump(exclude={"device"})
        verdict = "as recorded" if same else f"recorded {recorded.mean:.6g} on {printable(recorded.device)}"
        if not recorded.agrees(score):
            verdict += f", which is more than {_AGREEMENT:g} standard errors away"
            code = 1
        print(f"{name}: {score.mean:.6g} on {printable(score.device)}; {verdict}", flush=True)
    if evaluated:
        print(f"\n{zoo_table(evaluated)}")
    return code
