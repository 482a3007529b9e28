"""`--extend`: more trials or epochs for an existing experiment. Pure: lists of trials in, a list out.

A trial keeps its id, and so its folder: the id is the hash of its settings before any extension of its epochs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from msk_ray.errors import ConfigError
from msk_ray.experiment.trial import Trial, variant_text, with_epochs
from msk_ray.sweep.space import parse_seeds

KINDS = ("epochs", "samples", "seeds")


def parse_extension(texts: Sequence[str]) -> dict[str, Any]:
    """`["epochs=400", "seeds=0-4"]` as data.

    Raises:
        ConfigError: a key other than epochs, samples and seeds, or a value that is not a whole number.
    """
    extension: dict[str, Any] = {}
    for text in texts:
        kind, sign, value = text.partition("=")
        if kind not in KINDS or not sign:
            raise ConfigError(f"--extend {text!r}: write epochs=N, samples=N or seeds=LIST, such as seeds=0-4")
        if kind == "seeds":
            parse_seeds(value)
            extension[kind] = value
        elif value.isdecimal() and int(value) > 0:
            extension[kind] = int(value)
        else:
            raise ConfigError(f"--extend {text!r}: write a whole number, the new total")
    return extension


def extended_space(data: Mapping[str, Any], extension: Mapping[str, Any]) -> dict[str, Any]:
    """A space's plain data with an extension's samples and seeds."""
    return {**data, **{kind: extension[kind] for kind in ("samples", "seeds") if kind in extension}}


def extend_trials(recorded: Sequence[Trial], planned: Sequence[Trial], epochs: int | None) -> list[Trial]:
    """The trials of an extended experiment: the existing ones, in their order, then the new ones.

    Args:
        recorded: the experiment's current trials.
        planned: the trials of the extended space, with the space's epochs.
        epochs: new length of every trial; None keeps it.

    Raises:
        ConfigError: the extension would drop trials or shorten them, or trials have different lengths.
    """
    ids = {trial.id for trial in planned}
    gone = [trial for trial in recorded if trial.id not in ids]
    if gone:
        first = f"{variant_text(gone[0].changed)} seed {gone[0].seed}"
        raise ConfigError(
            f"--extend only adds, and would drop {len(gone)} trials ({first}, ...); name all seeds, old ones too"
        )
    known = {trial.id for trial in recorded}
    new = [trial for trial in planned if trial.id not in known]
    if epochs is None:
        # New trials run as long as the old ones, which an earlier extension may have lengthened.
        lengths = {trial.epochs for trial in recorded}
        epochs = lengths.pop() if len(lengths) == 1 else None
    elif len({trial.epochs for trial in planned}) > 1:
        raise ConfigError("--extend epochs: the space varies trial.epochs; start a new experiment instead")
    elif any(trial.epochs > epochs for trial in recorded):
        longest = max(trial.epochs for trial in recorded)
        raise ConfigError(f"--extend epochs={epochs}: trials have {longest} epochs already; write the new total")
    trials = [*recorded, *(replace(trial, index=len(recorded) + place) for place, trial in enumerate(new))]
    return trials if epochs is None else [with_epochs(trial, epochs) for trial in trials]
