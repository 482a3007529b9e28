"""Signals and Ray: only the driver handles requests to stop, whatever Ray does in the same process.

Ray's daemons and the trials' processes ignore these signals, even if one is sent to the whole process or control group
(`timeout`, systemd, `kill -- -PGID`): the driver asks trials to save themselves, and ends Ray when they have.
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
"""Blocked in Ray's processes, which inherit the mask; Ray itself blocks SIGINT that way. SIGTSTP (Ctrl-Z) must stop the
driver alone: a suspended trial looks like one that hangs."""
_TICK_S = 1.0
_POLL_S = 0.05
_LAST_WORD_S = 180.0
"""How long Tune's loop may take to end after a request to stop [s]; longer than trials may take to save themselves."""
_SHUTDOWN_LIMIT_S = 30.0
"""How long `ray.shutdown` may take [s]."""
_LAST_POLL_S = 2.0


@contextmanager
def starting_ray() -> Iterator[None]:
    """Context for `ray.init`: the processes it starts block the signals above, and this program's handlers are restored
    afterwards. Signals are deferred, because an exception during a `fork` can leave a lock behind, or be lost.

    Raises:
        KeyboardInterrupt: this program was asked to stop meanwhile.
    """
    stop = current()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, KEPT_FROM_CHILDREN)
    with nullcontext() if stop is None else stop.deferred():
        try:
            yield
        except SystemExit as error:
            # Ray's own handler, installed by `ray.init`, exits like this.
            if stop is None or error.code != signal.SIGTERM:
                raise
            stop.receive(signal.SIGTERM)
        finally:
            if stop is not None:
                stop.install()
            # Handle a signal that has arrived meanwhile.
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    if stop:
        raise KeyboardInterrupt


def end_ray(folder: SessionFolder | None, lost: bool = False, keep: bool = False) -> None:
    """`ray.shutdown` with a time limit; also kills everything that our own Ray has started.

    Ray's daemons do not receive SIGTERM, because `starting_ray` has blocked it in them: they are killed as soon as this
    process no longer needs them. A Ray that does not answer is left alone; this process must not wait for it when it
    exits.

    Args:
        folder: our own Ray's folder, if it is ours.
        lost: whether Ray is known not to answer.
        keep: whether to keep Ray's logs.

    Raises:
        ClusterLost: Ray did not answer.
        KeyboardInterrupt: this program was asked to stop meanwhile; Ray has been shut down anyway.
    """
    stop = current()
    # a daemon thread, because it may never end
    thread = threading.Thread(target=ray.shutdown, name="ray.shutdown", daemon=True)
    waited = 0.0
    try:
        if not lost:
            thread.start()
        while thread.is_alive() and waited < _SHUTDOWN_LIMIT_S:
            thread.join(_POLL_S)
            waited += _POLL_S
            if stop is not None:
                stop.install()  # Ray's shutdown removes SIGTERM's handler in the kernel, unseen by Python
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
    """Run Tune's loop in another thread, so that this one can always handle signals.

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

    # A daemon thread: if it waits for a dead cluster, it must not keep the process alive.
    thread = threading.Thread(target=body, name="tune", daemon=True)
    thread.start()
    # Count ticks instead of time, so that time while this process is suspended does not count.
    waited = 0.0
    while thread.is_alive():
        thread.join(_TICK_S)
        waited += _TICK_S if stop else 0.0
        lost = watch.look(_TICK_S)
        if lost is not None:
            thread.join(_TICK_S)  # the loop raises this itself, unless it waits for Ray
            raise lost
        if waited > _LAST_WORD_S:
            raise ClusterLost(
                "Ray did not answer the request to stop; --resume continues the trials from their checkpoints"
            )
    if failure:
        raise failure[0]
