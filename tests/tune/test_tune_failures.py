"""Which exceptions end a trial at once, and how they are named."""

import errno
import math
import os
import re
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from stub_trainer import BEHAVIOUR, BROKEN_CONNECTION, BUG, EXIT, EXIT_ZERO, INTERRUPT, StubTrainer

from msk_ray.config import Config
from msk_ray.experiment.checkpoint_format import read_facts
from msk_ray.experiment.layout import OUTCOME_FILE
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.outcomes import Ending, Outcome, read_ending
from msk_ray.files import read_file
from msk_ray.signals import listening
from msk_ray.sweep.rules.stopping import StopSpec
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune.failures import described, repeats
from msk_ray.tune.trial_run import Hooks, run_trial


class AcceleratorError(RuntimeError):
    """As torch raises it."""


class OutOfTime(TimeoutError):
    """An error of a library that is derived from one of the system's."""


def raised(error: BaseException) -> BaseException:
    try:
        raise error
    except BaseException as caught:
        return caught


def met(work: Callable[[], object]) -> Exception:
    try:
        work()
    except Exception as caught:
        return caught
    raise AssertionError("nothing was raised")


@pytest.mark.parametrize(
    ("error", "again"),
    [
        (ValueError("shape"), True),
        (RuntimeError("mat1 and mat2 shapes cannot be multiplied"), True),
        (FileNotFoundError(errno.ENOENT, "no such file", "motion.npz"), True),
        (SystemExit(3), True),
        (RuntimeError("Warp CUDA error 700: an illegal memory access was encountered"), False),
        (RuntimeError("CUDNN_STATUS: cuDNN error: EXECUTION_FAILED"), False),
        (AcceleratorError("unspecified launch failure"), False),
        (MemoryError(), False),
        (ConnectionResetError(errno.ECONNRESET, "reset"), False),
        (OutOfTime("rendezvous"), False),
        (BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"), False),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else str(value),
)
def test_what_another_process_would_meet_again(error: BaseException, again: bool) -> None:
    assert repeats(raised(error)) is again


def test_errors_of_ray_are_not_the_trials() -> None:
    from ray.exceptions import GetTimeoutError

    assert not repeats(raised(GetTimeoutError("the driver is busy")))


def test_a_file_that_the_package_misses_may_be_back(tmp_path: Path) -> None:
    """Where the user's own code has named it, it is not there: see above."""
    assert not repeats(met(lambda: read_file(tmp_path / "epoch_000002.pt", 1)))
    assert repeats(met((tmp_path / "motion.npz").read_bytes))


def test_an_exception_is_named_with_file_and_line() -> None:
    def reward_terms() -> None:
        raise ValueError("first line\nsecond line")

    match = re.fullmatch(r"ValueError: first line \((.+):(\d+), in reward_terms\)", described(met(reward_terms)))
    assert match is not None
    assert match[1] == Path(__file__).name
    assert 'raise ValueError("first line' in Path(__file__).read_text().splitlines()[int(match[2]) - 1]


def test_the_users_own_line_is_named_rather_than_the_librarys() -> None:
    def observe() -> None:
        re.compile("(")

    assert re.search(rf"\({Path(__file__).name}:\d+, in observe\)$", described(met(observe)))


def test_an_error_of_another_process_is_named_by_its_notes() -> None:
    error = raised(ValueError("shape"))
    error.add_note('In a process of the trial, 1:\nTraceback:\n  File "/home/me/own.py", line 12, in observe\n    x')
    assert described(error) == "ValueError: shape (own.py:12, in observe)"


def run(make_space: Any, folder: Path, behaviour: float) -> Any:
    (trial,) = resolve_trials(make_space(parameters={BEHAVIOUR: {"grid": [behaviour]}}))
    folder.mkdir()
    return run_trial(trial, folder, "cpu", StopSpec(), StubTrainer, Hooks())


@pytest.mark.parametrize(
    ("behaviour", "why"),
    [
        (BUG, "RuntimeError: made up"),
        (EXIT, "sys.exit(3) was called"),
        (EXIT_ZERO, "sys.exit(0) was called"),
        (INTERRUPT, "KeyboardInterrupt"),
    ],
)
def test_an_error_of_ones_own_ends_the_trial(behaviour: float, why: str, make_space: Any, tmp_path: Path) -> None:
    ending = run(make_space, tmp_path / "trial", behaviour)
    assert ending.outcome is Outcome.ERROR
    assert re.fullmatch(rf"{re.escape(why)} \(stub_trainer\.py:\d+, in _misbehave\)", ending.why)
    assert read_ending(tmp_path / "trial") == ending
    assert "in _misbehave" in (tmp_path / "trial" / "error.txt").read_text()


def test_an_error_of_the_machine_does_not(make_space: Any, tmp_path: Path) -> None:
    with pytest.raises(ConnectionResetError):
        run(make_space, tmp_path / "trial", BROKEN_CONNECTION)
    assert read_ending(tmp_path / "trial") is None
    assert (tmp_path / "trial" / "error.txt").is_file()


def test_ctrl_c_is_no_error_of_the_trial(make_space: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in `--debug-trial`."""
    monkeypatch.setattr(StubTrainer, "_misbehave", lambda self, row: os.kill(os.getpid(), signal.SIGINT))
    with listening(), pytest.raises(KeyboardInterrupt):
        run(make_space, tmp_path / "trial", BUG)
    assert read_ending(tmp_path / "trial") is None


def test_an_infinite_score_is_named_as_nan_is_and_a_retry_repeats_its_epoch(
    tiny_cartpole: Config, tmp_path: Path, make_space: Any
) -> None:
    from msk_ray.training import Trainer
    from msk_ray.training.evaluation import Evaluator

    (trial, *_) = resolve_trials(make_space())
    trial = replace(trial, config=tiny_cartpole)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Evaluator, "run", lambda self, policies: [{"score": math.inf}])
        ending = run_trial(trial, tmp_path, "cpu", StopSpec(), Trainer, Hooks())
    assert ending == Ending(Outcome.NONFINITE, "eval/score is inf at epoch 2")
    assert read_facts(tmp_path / "checkpoints" / "best.pt")["best_score"] is None  # no policy has a score yet
    (tmp_path / OUTCOME_FILE).unlink()
    ending = run_trial(trial, tmp_path, "cpu", StopSpec(), Trainer, Hooks())
    assert ending is not None
    assert ending.outcome is Outcome.FINISHED
    assert all(math.isfinite(row["eval/score"]) for row in read_rows(tmp_path) if "eval/score" in row)
