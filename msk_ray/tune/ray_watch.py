"""Watches whether this process's Ray session is alive."""

import threading
from collections.abc import Callable

import ray
from ray._private.worker import global_worker

from msk_ray.errors import ClusterLost

_VITAL = ("gcs_server", "raylet")
"""Essential daemons of Ray."""


class RayWatch:
    """Asks Ray periodically, from a separate thread, whether this process's node is alive. Without that, Ray would wait
    for an answer without a limit, and end this process after a minute.

    A context manager: the thread runs inside the block.
    """

    INTERVAL_S = 2.0
    LIMIT_S = 40.0
    """How long Ray may be silent [s]; less than the minute after which Ray itself ends this process."""

    def __init__(self) -> None:
        self._id = ray.get_runtime_context().get_node_id()
        self._ended = threading.Event()
        self._silent_s = 0.0
        self._refusal: Exception | None = None
        self._node_died = False
        self.lost: ClusterLost | None = None
        """Why Ray is lost; None if it is not."""

    def __enter__(self) -> "RayWatch":
        threading.Thread(target=self._ask, name="ray watch", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()

    def look(self, passed_s: float) -> ClusterLost | None:
        """Update and return why Ray is lost; None if it is not.

        Args:
            passed_s: time since the last check [s], without time while this process was suspended.
        """
        self._silent_s += passed_s
        died = _dead_daemon()
        if self.lost is not None:
            pass
        elif died is not None:
            self.lost = ClusterLost(f"Ray's process {died} on this machine has died; continue with --resume")
        elif self._node_died:
            self.lost = ClusterLost("the Ray node of this machine has died (raylet killed?); continue with --resume")
        elif self._silent_s > self.LIMIT_S:
            why = "" if self._refusal is None else f" ({str(self._refusal).splitlines()[0]})"
            self.lost = ClusterLost(f"Ray has not answered for {self.LIMIT_S:.0f} s{why}; continue with --resume")
        return self.lost

    def guarding(self, guard: Callable[[], None]) -> Callable[[], None]:
        """A check to call before writing: `guard`, and that Ray is not lost. Once it is, Tune reports wrong states of
        trials.

        Raises:
            ClusterLost: raised by the check.
        """

        def check() -> None:
            if self.lost is not None:
                raise self.lost
            guard()

        return check

    def _ask(self) -> None:
        while not self._ended.wait(self.INTERVAL_S):
            try:
                nodes = ray.nodes()
            except Exception as error:  # any of Ray's exceptions; the time limit decides
                self._refusal = error
                continue
            self._silent_s, self._refusal = 0.0, None
            self._node_died = any(node["NodeID"] == self._id and not node["Alive"] for node in nodes)


def _dead_daemon() -> str | None:
    """Name of an essential daemon, started by this process, that has died; None if all are alive."""
    if global_worker.node is None:
        return None
    return next((name for name, _ in global_worker.node.dead_processes() if name in _VITAL), None)
