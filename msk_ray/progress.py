"""A line that shows the progress of training with an estimate of the time left."""

import sys
import time

from msk_ray.metrics import BEST_SCORE, REWARD, SCORE, STEPS_PER_SECOND
from msk_ray.text import printable


class ProgressLine:
    """Shows epoch, speed, scores and time left: in place on a terminal, elsewhere as a line every ten seconds."""

    def __init__(self, epochs: int) -> None:
        self._epochs = epochs
        self._first: tuple[int, float] | None = None
        """First epoch shown and its time, to exclude compilation from the speed."""
        self._last_line = -1e9
        self._terminal = sys.stdout.isatty()
        self._score = ""

    def show(self, row: dict[str, float]) -> None:
        """Show a row of metrics."""
        epoch = int(row["epoch"])
        now = time.monotonic()
        if self._first is None:
            self._first = epoch, now
        ran, since = epoch - self._first[0], now - self._first[1]
        left = since / ran * (self._epochs - epoch) if ran else None
        if SCORE in row:
            best = f" (best {row[BEST_SCORE]:.1f})" if BEST_SCORE in row else ""
            self._score = f"eval {row[SCORE]:.1f}{best}"
        parts = [
            f"epoch {epoch}/{self._epochs}",
            f"{row[STEPS_PER_SECOND]:,.0f} env steps/s",
            # A user's algorithm need not have it.
            f"reward {row[REWARD]:.3f}" if REWARD in row else "",
            self._score,
            "not recorded: two to three times as slow" if row.get("train/unrecordable") else "",
            f"{format_duration(left)} left" if left is not None else "",
        ]
        text = "  ".join(filter(None, parts))
        if self._terminal:
            print(f"\r\x1b[K{text}", end="", flush=True)
        elif now - self._last_line >= 10.0 or epoch == self._epochs:
            print(text, flush=True)
            self._last_line = now

    def close(self) -> None:
        """End the line."""
        if self._terminal:
            print()


COMPILING = "kernels that are not in Warp's cache are compiled first: up to a minute on a CPU"


def announce(text: str) -> None:
    """Print what a command is about to do, because it may take a while."""
    print(f"{printable(text)} ...", flush=True)


class Pace:
    """Prints a command's progress and time left, after two seconds and then every ten."""

    FIRST_S, EVERY_S = 2.0, 10.0

    def __init__(self, unit: str, total: int) -> None:
        """
        Args:
            unit: what is counted, in the plural.
            total: how many there are.
        """
        self._unit, self._total = unit, total
        self._start = time.monotonic()
        self._due = self._start + self.FIRST_S

    def __call__(self, done: int) -> None:
        """Report that `done` units are done."""
        now = time.monotonic()
        if now < self._due or not 0 < done < self._total:
            return
        self._due = now + self.EVERY_S
        left = (now - self._start) / done * (self._total - done)
        print(f"  {done} of {self._total} {self._unit}, about {format_duration(left)} left", flush=True)


class KernelCount:
    """Shows how many kernels are ready and for how long the others have been compiled, from two seconds on: in place on
    a terminal, elsewhere as a line every ten seconds, and at the end."""

    FIRST_S, EVERY_S = 2.0, 10.0

    def __init__(self) -> None:
        self._start: float | None = None
        self._due = 0.0
        self._shown = False
        self._terminal = sys.stdout.isatty()

    def __call__(self, done: int, total: int) -> None:
        """Report that `done` of `total` kernels are ready."""
        now = time.monotonic()
        if self._start is None:
            self._start, self._due, self._shown = now, now + self.FIRST_S, False
        last = done == total
        if now >= self._due or (last and self._shown):
            text = f"kernels {done} of {total}, {format_duration(now - self._start)}"
            self._shown = True
            if self._terminal:
                print(f"\r\x1b[K{text}", end="\n" if last else "", flush=True)
            else:
                print(text, flush=True)
                self._due = now + self.EVERY_S
        if last:
            self._start = None


def format_duration(seconds: float) -> str:
    """Seconds as 45s, 3m20s or 2h05m."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole}s"
    if whole < 3600:
        return f"{whole // 60}m{whole % 60:02d}s"
    return f"{whole // 3600}h{whole % 3600 // 60:02d}m"
