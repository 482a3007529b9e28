"""What the command-line entry points share."""

import argparse
import signal
import sys
from collections.abc import Callable, Sequence

from msk_ray.errors import MskRayError

RESUMABLE = 75
"""Exit code of a run that was asked to stop and saved its state (EX_TEMPFAIL)."""


class Parser(argparse.ArgumentParser):
    """An argument parser that keeps the examples in its help as they are written."""

    def __init__(self, prog: str, description: str, examples: str) -> None:
        super().__init__(
            prog=prog,
            description=description,
            epilog=f"examples:\n{examples}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )


def run(main: Callable[[Sequence[str] | None], int], argv: Sequence[str] | None = None) -> int:
    """Run an entry point: a fault the user can mend becomes one line on stderr and a non-zero exit code."""
    try:
        return main(argv)
    except MskRayError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output, such as `head`, has left.
        sys.stderr.close()
        return 0


class StopRequest:
    """Set by SIGINT, SIGTERM or SIGUSR1; the loop that owns it stops at its next safe point.

    A second SIGINT interrupts at once.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self.install()

    def install(self) -> None:
        """Take over the signals, again if a library has taken them meanwhile."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1):
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: object) -> None:
        if self.signal is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal = signal.Signals(number)

    def __bool__(self) -> bool:
        return self.signal is not None
