"""Signals and Ray: only the driver receives requests to stop, whatever Ray does in the same process.

Ray's daemons and the trials' processes receive none of these signals, even if one is sent to the whole process group or
control group (`timeout`, systemd, `kill -- -PGID`): trials are asked to save themselves, and Ray ends when they have.
"""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

import ray

from msk_ray import cli
from msk_ray.errors import ClusterLost
from msk_ray.signals import StopRequest, current
from msk_ray.tune.ray_watch import RayWatch
from msk_ray.tune.session_folder import SessionFolder

KEPT_FROM_CHILDREN = {signal.SIGHUP, signal.SIGTERM, signal.SIGUSR1, signal.SIGTSTP}
"""Blocked in Ray's processes, which inherit that; Ray itself does the same with SIGINT. SIGTSTP (Ctrl-Z) stops the
driver alone: a trial that is stopped cannot be told from one that hangs."""
_TICK_S = 1.0
_POLL_S = 0.05
_LAST_WORD_S = 180.0
"""How long Tune's loop may take to end, after a request to stop [s]; more than trials get to save themselves."""
_SHUTDOWN_LIMIT_S = 30.0
"""How long `ray.shutdown` may take [s]."""
_LAST_POLL_S = 2.0


@contextmanager
def starting_ray() -> Iterator[None]:
    """For `ray.init`: the processes it starts do not receive the signals above, and this program's handlers are
    restored. It is not interrupted: an exception between a `fork` and its end can leave a lock behind, or be lost.

    Raises:
        KeyboardInterrupt: this program was asked to stop in the meantime.
    """
    stop = current()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, KEPT_FROM_CHILDREN)
    with nullcontext() if stop is None else stop.deferred():
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
    if stop:
        raise KeyboardInterrupt


def end_ray(folder: SessionFolder | None, lost: bool = False, keep: bool = False) -> None:
    """`ray.shutdown` with a limit, and the end of all that a Ray of our own has started.

    Ray's daemons do not hear that they are asked to go, because `starting_ray` has blocked the signal in them: they are
    ended as soon as this process does not need them any more. A Ray that does not answer is left as it is; this process
    must not wait for it at its own end.

    Args:
        folder: of a Ray of our own.
        lost: whether it is known not to answer.
        keep: whether Ray's logs are kept.

    Raises:
        ClusterLost: Ray did not answer.
        KeyboardInterrupt: this program was asked to stop in the meantime; Ray has been ended all the same.
    """
    stop = current()
    # A daemon, because it may never end.
    thread = threading.Thread(target=ray.shutdown, name="ray.shutdown", daemon=True)
    waited = 0.0
    try:
        if not lost:
            thread.start()
        while thread.is_alive() and waited < _SHUTDOWN_LIMIT_S:
            thread.join(_POLL_S)
            waited += _POLL_S
            if stop is not None:
                stop.install()  # Ray's end takes SIGTERM's handler away, in the kernel where Python does not see it
            if folder is not None and not ray.is_initialized():
                folder.end_processes()
    finally:
        if folder is not None:
            folder.end_processes()
        if thread.ident is not None:
            thread.join(_LAST_POLL_S)
        if folder is not None:
            folder.close(keep)  # until then, Ray's end still writes into it
        if lost or thread.is_alive():
            cli.end_at_once()
        if stop is not None:
            stop.install()
    if thread.is_alive():
        raise ClusterLost(f"Ray did not end within {_SHUTDOWN_LIMIT_S:.0f} s; continue with --resume")


def run_in_thread(work: Callable[[], object], stop: StopRequest, watch: RayWatch) -> None:
    """Run Tune's loop in a thread, where it receives no signals and cannot keep this thread from receiving them.

    Raises:
        ClusterLost: Ray has died or does not answer, or the loop did not end when asked to.
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
        lost = watch.look(_TICK_S)
        if lost is not None:
            thread.join(_TICK_S)  # it raises that too, unless it waits for Ray
            raise lost
        if waited > _LAST_WORD_S:
            raise ClusterLost(
                "Ray did not answer the request to stop; --resume continues the trials from their checkpoints"
            )
    if failure:
        raise failure[0]
