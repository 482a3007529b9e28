"""Signals that ask a program to stop: from its first line to its last they mean "save what there is, exit 75".

What a signal does depends on what goes on: while modules load, nothing has begun and the process ends at once; later
the running code is interrupted, as by Ctrl-C; and a loop that can save what it has done (`StopRequest.deferred`) is
only told, and stops by itself at its next safe point. Imports the standard library alone, so that a program can begin
with it.
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
    """Set by the first of `NUMBERS` that arrives; a second SIGINT interrupts whatever runs.

    SIGHUP, which comes when the terminal closes, stays ignored where it is: nohup.

    Attributes:
        signal: the one that arrived; None before.
        insisted: whether a second SIGINT arrived.
        loading: whether nothing has begun yet, so that a request ends the process at once.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self.insisted = False
        self.loading = False
        self._deferred = False

    def install(self) -> None:
        """Take over the signals, again if a library has taken them meanwhile."""
        for number in NUMBERS:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self.receive)

    @contextlib.contextmanager
    def deferred(self) -> Iterator[None]:
        """For a loop that asks this object itself whether to stop.

        Raises:
            KeyboardInterrupt: on entry, if the request has been made already.
        """
        self._deferred = True
        try:
            if self:
                # It may have interrupted code that let no exception through, such as a destructor.
                raise KeyboardInterrupt
            yield
        finally:
            self._deferred = False

    def settle(self) -> None:
        """The work is done and the exit code known: a request changes nothing any more.

        Ignored rather than handled: an interpreter that ends takes handlers away before it has ended.
        """
        for number in NUMBERS:
            signal.signal(number, signal.SIG_IGN)

    def receive(self, number: int, frame: FrameType | None = None) -> None:
        """Do what a signal of this number asks for."""
        first = self.signal is None
        if first:
            self.signal = signal.Signals(number)
        elif number == signal.SIGINT:
            self.insisted = True
        else:
            return
        if self.loading:
            # Raised here, an exception would meet whatever module is half loaded.
            with contextlib.suppress(OSError):  # with the terminal goes whoever reads from it
                os.write(2, f"stopped by {self.signal.name} before anything began\n".encode())  # type: ignore[union-attr]
            os._exit(RESUMABLE)
        if self.insisted or not self._deferred:
            raise KeyboardInterrupt

    def __bool__(self) -> bool:
        return self.signal is not None


_current: StopRequest | None = None


def listen() -> StopRequest:
    """Begin to listen, for the life of this process: the first line of a program. While it is `loading`, a request ends
    it."""
    global _current
    if _current is None:
        _current = StopRequest()
        _current.loading = True
        _current.install()
    return _current


def current() -> StopRequest | None:
    """Whoever listens; None in a program that signals end as they end any other."""
    return _current


@contextlib.contextmanager
def listening() -> Iterator[StopRequest]:
    """Whoever listens; where nobody does, as under a test runner, one for this block."""
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
