"""Signals that ask a program to stop, which at any time means "save everything, exit with 75".

The effect depends on the phase. While modules are imported, the process ends at once. Later the running code is
interrupted, as by Ctrl-C. A loop that can save its work (`StopRequest.deferred`) is only notified, and stops at its
next safe point. This module imports only the standard library, so that it can be a program's first import.
"""

import contextlib
import os
import signal
from collections.abc import Iterator
from types import FrameType

RESUMABLE = 75
"""Exit code of a run that was asked to stop and saved its state (EX_TEMPFAIL)."""
NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
"""The signals that ask to stop."""


class StopRequest:
    """A request to stop: set by the first of the signals `NUMBERS`; a second SIGINT interrupts the running code.

    SIGHUP, which a closing terminal sends, stays ignored if it already is (nohup).

    Attributes:
        signal: the signal that arrived; None before.
        insisted: whether a second SIGINT arrived.
        loading: whether nothing has started yet, so that a request ends the process at once.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self.insisted = False
        self.loading = False
        self._deferred = False

    def install(self) -> None:
        """Install the handlers, or reinstall them after a library has replaced them."""
        for number in NUMBERS:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self.receive)

    @contextlib.contextmanager
    def deferred(self) -> Iterator[None]:
        """Context for a loop that checks this object to know whether to stop.

        Raises:
            KeyboardInterrupt: on entry, if a stop has already been requested.
        """
        self._deferred = True
        try:
            if self:
                # The request may have interrupted code that suppresses exceptions, such as a destructor.
                raise KeyboardInterrupt
            yield
        finally:
            self._deferred = False

    def settle(self) -> None:
        """Ignore further requests, because the work is done and the exit code known.

        Signals are ignored, not handled, because an exiting interpreter removes its handlers before it has ended.
        """
        for number in NUMBERS:
            signal.signal(number, signal.SIG_IGN)

    def receive(self, number: int, frame: FrameType | None = None) -> None:
        """Handle a signal."""
        first = self.signal is None
        if first:
            self.signal = signal.Signals(number)
        elif number == signal.SIGINT:
            self.insisted = True
        else:
            return
        if self.loading:
            # An exception raised here would hit a half-imported module.
            with contextlib.suppress(OSError):  # the terminal may be closed
                os.write(2, f"stopped by {self.signal.name} before anything started\n".encode())  # type: ignore[union-attr]
            os._exit(RESUMABLE)
        if self.insisted or not self._deferred:
            raise KeyboardInterrupt

    def __bool__(self) -> bool:
        return self.signal is not None


_current: StopRequest | None = None


def listen() -> StopRequest:
    """Listen from now on; call this in the first line of a program. While the program is `loading`, a request ends
    it."""
    global _current
    if _current is None:
        _current = StopRequest()
        _current.loading = True
        _current.install()
    return _current


def current() -> StopRequest | None:
    """The listener; None if this program does not listen."""
    return _current


@contextlib.contextmanager
def listening() -> Iterator[StopRequest]:
    """Context with the listener; if there is none, as under a test runner, a temporary one."""
    global _current
    if _current is not None:
        yield _current
        return
    kept = {number: signal.getsignal(number) for number in NUMBERS}
    _current = StopRequest()
    _current.install()
    try:
        yield _current
    finally:
        _current = None
        for number, handler in kept.items():
            signal.signal(number, handler)
