"""The Ray session of a sweep, from start to end: our own on this machine (`local_ray`), or a running cluster."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import ray
from ray._private import auto_init_hook

from msk_ray.errors import ClusterLost, DeviceError, MskRayError
from msk_ray.progress import announce
from msk_ray.tune import worker_prestart
from msk_ray.tune.interrupts import end_ray, starting_ray
from msk_ray.tune.local_ray import make_token_private, start_local, way_in
from msk_ray.tune.session_folder import SessionFolder

_CONNECT_S = 20.0
"""How long to wait for a cluster's answer [s]."""


@contextmanager
def ray_session(address: str | None, dashboard: bool | None = None, trials: bool = True) -> Iterator[None]:
    """Context of a Ray session: our own on this machine, or the one at `address`.

    Args:
        address: address of a running cluster.
        dashboard: whether to start one; None: only if its packages (ray[default]) are installed.
        trials: whether trials will run; then every process imports what they need as soon as it starts.

    Raises:
        DeviceError: the cluster at `address` cannot be reached.
        StorageError: there is no suitable folder for our own Ray's files or token.
        ClusterLost: Ray does not start, or does not shut down.
    """
    os.environ.update(
        RAY_AIR_NEW_OUTPUT="0",
        RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO="1",  # a trial without GPUs must see none, not all
        TUNE_DISABLE_AUTO_CALLBACK_LOGGERS="1",  # trials write their own metrics, at once
        TUNE_DISABLE_STRICT_METRIC_CHECKING="1",  # a trial may stop before its first evaluation
        TUNE_GLOBAL_CHECKPOINT_S="inf",  # Tune's own state grows with every trial, and nothing reads it
        TUNE_DISABLE_SIGINT_HANDLER="1",  # on a request to stop, trials first save themselves
    )
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Otherwise Ray would start a cluster when it is used after `ray.shutdown`, as a thread of Tune's may do. The
    # variable is for later processes: this one read it when Ray was imported.
    os.environ["RAY_ENABLE_AUTO_CONNECT"] = "0"
    auto_init_hook.enable_auto_connect = False
    # Off by default because it lets users run programs, but it needs the token, and anyone with the token can anyway.
    os.environ.setdefault("RAY_DASHBOARD_ENABLE_PROFILING", "1")
    # Otherwise Ray would run trials at a low priority.
    os.environ.setdefault("RAY_worker_niceness", "0")
    common: dict[str, Any] = {
        "logging_level": "ERROR",
        "log_to_driver": False,
        "runtime_env": {"worker_process_setup_hook": worker_prestart.HOOK} if trials else None,
    }
    if address is None:
        announce("starting Ray")
        make_token_private()
    folder = SessionFolder() if address is None else None
    lost = keep = False
    try:
        with starting_ray():
            context = _init(address, dashboard, common)
        if context.dashboard_url:
            print(f"Ray dashboard: http://{context.dashboard_url}{way_in()}", flush=True)
        elif dashboard is None:
            print("no Ray dashboard: pip install 'ray[default]' to have one", flush=True)
        yield
    except Exception as error:
        lost = isinstance(error, ClusterLost)
        keep = folder is not None and (lost or not isinstance(error, MskRayError))
        raise
    finally:
        end_ray(folder, lost, keep)
        if folder is not None and keep:
            print(f"Ray's logs, until the next sweep starts: {folder.logs}", flush=True)


def _init(address: str | None, dashboard: bool | None, common: dict[str, Any]) -> Any:
    if address is None:
        return start_local(dashboard, common)
    try:
        check_reachable(address)
        return ray.init(address=address, **common)
    except OSError as error:  # ConnectionError too
        raise DeviceError(
            f"no Ray cluster at {address} (--address or RAY_ADDRESS): {str(error).splitlines()[0]}"
        ) from error


def check_reachable(address: str) -> None:
    """Check that something listens at HOST:PORT, because Ray itself would try for minutes. Other addresses pass.

    Raises:
        OSError: nothing listens there.
    """
    host, _, port = address.rpartition(":")
    if "://" not in address and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=_CONNECT_S).close()


def cluster_gpus(processes: int = 1) -> int:
    """Number of the Ray session's GPUs; for trials with several GPUs, the number on the largest node."""
    of_nodes = [int(node["Resources"].get("GPU", 0)) for node in ray.nodes() if node["Alive"]]
    return max(of_nodes, default=0) if processes > 1 else sum(of_nodes)
