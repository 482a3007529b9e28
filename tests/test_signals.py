"""What a request to stop does: ends, interrupts, or waits for the loop that saves."""

import os
import signal
import subprocess
import sys

import pytest

from msk_ray.__main__ import main
from msk_ray.signals import NUMBERS, RESUMABLE, current, listening


@pytest.mark.parametrize("number", NUMBERS)
def test_a_request_interrupts_what_cannot_save(number: signal.Signals) -> None:
    with listening() as stop:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
        assert stop.signal is number
        assert not stop.insisted


@pytest.mark.parametrize("number", NUMBERS)
def test_a_loop_that_saves_is_told(number: signal.Signals) -> None:
    with listening() as stop, stop.deferred():
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), signal.SIGTERM)  # a second one changes nothing
        assert stop.signal is number
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)  # unless it is Ctrl-C
        assert stop.insisted


def test_a_request_that_interrupted_nothing_is_heard_when_the_loop_begins() -> None:
    with listening() as stop:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt), stop.deferred():
            pytest.fail("it began")


def test_a_library_that_takes_a_signal_loses_it_again() -> None:
    with listening() as stop, stop.deferred():
        signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(number))
        stop.install()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.signal is signal.SIGTERM


@pytest.mark.parametrize("ignored", [False, True])
def test_hangup_asks_to_stop_unless_it_is_ignored(ignored: bool) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
    try:
        with listening() as stop, stop.deferred():
            stop.install()  # again, as after a library has taken signals
            os.kill(os.getpid(), signal.SIGHUP)
            assert stop.signal is (None if ignored else signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_the_handlers_of_others_come_back() -> None:
    before = [signal.getsignal(number) for number in NUMBERS]
    with listening() as outer, listening() as inner:
        assert inner is outer
    assert [signal.getsignal(number) for number in NUMBERS] == before


@pytest.mark.parametrize(
    ("body", "code", "output"),
    [
        ("os.kill(os.getpid(), signal.SIGTERM); run(lambda argv: 0)", RESUMABLE, "SIGTERM before anything started\n"),
        ("sys.exit(run(lambda argv: os.kill(os.getpid(), signal.SIGUSR1)))", RESUMABLE, "stopped by SIGUSR1\n"),
        ("code = run(lambda argv: 0); os.kill(os.getpid(), signal.SIGTERM); sys.exit(code)", 0, ""),
        # When modules are taken down, handlers have been.
        (
            "class Last:\n  def __del__(self, kill=os.kill, pid=os.getpid()): kill(pid, 15)\n"
            "last = Last(); sys.exit(run(lambda argv: 75))",
            RESUMABLE,
            "",
        ),
    ],
)
def test_from_the_first_line_to_the_last(body: str, code: int, output: str) -> None:
    program = (
        f"from msk_ray import signals; signals.listen()\nimport os, signal, sys\nfrom msk_ray.cli import run\n{body}"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr.endswith(output)
    assert "Traceback" not in done.stderr


def test_a_program_run_in_this_process_takes_no_signal_for_good() -> None:
    """Which `signals_as_before` of conftest.py sees to; the next test fails without it."""
    with pytest.raises(SystemExit) as ended:
        main(["train", "--help"])
    assert ended.value.code == 0
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN


def test_after_it_signals_do_what_they_did_before() -> None:
    assert current() is None
    assert signal.getsignal(signal.SIGTERM) is not signal.SIG_IGN
