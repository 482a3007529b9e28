"""Signals and Ray: only the driver receives requests to stop, whatever Ray does in the same process.

Ray's daemons and the trials' processes receive none of these signals, even if one is sent to the whole process group or
control group (`timeout`, systemd, `kill -- -PGID`): trials are asked to save themselves, and Ray ends when they have.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import ray

from msk_ray.errors import ClusterLost
from msk_ray.signals import StopRequest, current

KEPT_FROM_CHILDREN = {signal.SIGHUP, signal.SIGTERM, signal.SIGUSR1, signal.SIGTSTP}
"""Blocked in Ray's processes, which inherit that; Ray itself does the same with SIGINT. SIGTSTP (Ctrl-Z) stops the
driver alone: a trial that is stopped cannot be told from one that hangs."""
_TICK_S = 1.0
_POLL_S = 0.05
_LAST_WORD_S = 180.0
"""How long Ray may take to end, after a request to stop [s]; more than trials get to save themselves."""


@contextmanager
def starting_ray() -> Iterator[None]:
    """For `ray.init`: the processes it starts do not receive the signals above, and this program's handlers are
    restored.

    Raises:
        KeyboardInterrupt: this program was asked to stop in the meantime.
    """
    stop = current()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, KEPT_FROM_CHILDREN)
    try:
        yield
    except SystemExit as error:
        # Ray's own handler, installed at the start of `ray.init`, exits like this.
        if stop is None or error.code != signal.SIGTERM:
            raise
        stop.receive(signal.SIGTERM)
    finally:
        if stop is not None:
            stop.install()
        # A signal that arrived in the meantime is handled now.
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_ray() -> None:
    """`ray.shutdown`, and an end to the daemons that `starting_ray` has let start: they do not hear that they are asked
    to go, for which Ray gives each of them a second. Their agents would try for a minute to tell a daemon that has gone
    about the other's end."""
    done = threading.Event()

    def end_daemons() -> None:
        while not done.wait(_POLL_S):
            if not ray.is_initialized():  # while it is, this process needs them
                daemons = _deaf_children(os.getpid())
                agents = [pid for daemon in daemons for pid in _deaf_children(daemon) if _is_agent(pid)]
                for pid in (*daemons, *agents):
                    with suppress(ProcessLookupError):  # Ray was faster
                        os.kill(pid, signal.SIGKILL)

    thread = threading.Thread(target=end_daemons)
    thread.start()
    try:
        ray.shutdown()
    finally:
        done.set()
        thread.join()


def _deaf_children(parent: int) -> list[int]:
    """Child processes of a process that have SIGTERM blocked."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            lines = (entry / "status").read_text().splitlines()
        except OSError:
            continue  # it has ended meanwhile
        facts = dict(line.split(":", 1) for line in lines if ":" in line)
        if int(facts["PPid"]) == parent and int(facts["SigBlk"], 16) >> (signal.SIGTERM - 1) & 1:
            found.append(int(entry.name))
    return found


def _is_agent(pid: int) -> bool:
    """Whether a child of a raylet is one of the agents that it keeps, rather than a worker, which ends by itself."""
    with suppress(OSError):
        return b"Agent" in Path(f"/proc/{pid}/cmdline").read_bytes()
    return False  # it has ended meanwhile


def run_in_thread(work: Callable[[], object], stop: StopRequest) -> None:
    """Run Tune's loop in a thread, where it receives no signals and cannot keep this thread from receiving them.

    Raises:
        ClusterLost: the loop did not end when asked to, because Ray does not answer.
        Exception: whatever the loop raised.
    """
    failure: list[BaseException] = []

    def body() -> None:
        try:
            work()
        except BaseException as error:
            failure.append(error)

    # A daemon: one that waits for a dead cluster must not keep the process.
    thread = threading.Thread(target=body, name="tune", daemon=True)
    thread.start()
    # Ticks rather than a clock: time during which this process itself is stopped does not count.
    waited = 0.0
    while thread.is_alive():
        thread.join(_TICK_S)
        waited += _TICK_S if stop else 0.0
        if waited > _LAST_WORD_S:
            raise ClusterLost(
                "Ray did not answer the request to stop; --resume continues the trials from their checkpoints"
            )
    if failure:
        raise failure[0]
