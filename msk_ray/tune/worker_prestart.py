"""Start processes for the next trials in advance, with all imports done, because imports are the slowest part of a
start.

Every trial still gets its own process. A waiting process uses no GPU: CUDA is initialised when a trial starts in it, on
that trial's GPU. Ray has no public interface for this, so it may fail with another version of Ray. Then one line says
so, trials start a few seconds later, and nothing else changes.
"""

import importlib
import os
from collections.abc import Callable
from typing import Any

import ray
from ray.tune import Callback

from msk_ray.tune.devices import Placement

MODULES = ("msk_ray.training", "msk_ray.tune.trainable")
"""Modules that a trial's process imports."""
KEEP_S = 24 * 3600
"""How long Ray keeps an unused process [s]; unused processes end with the driver."""
_CALL_LIMIT_S = 10.0


def import_all() -> None:
    """Run by every trial process when it starts. Failed imports are reported later by the trial."""
    # Numerical libraries read this when imported; a trial sets its own number (`execution.threads`).
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle threads sleep instead of spinning
    # CUDA reads this once, when it is initialised. If an import initialised it, the trial must fail without a GPU, not
    # run on another trial's.
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    os.environ["CUDA_VISIBLE_DEVICES"] = ""
    for name in MODULES:
        importlib.import_module(name)
    if visible is None:
        del os.environ["CUDA_VISIBLE_DEVICES"]
    else:
        os.environ["CUDA_VISIBLE_DEVICES"] = visible


HOOK = f"{import_all.__module__}.{import_all.__name__}"
"""Part of the Ray session's runtime environment."""


def nodes_for(placement: Placement) -> list[dict[str, Any]]:
    """Ray's description of every living node that has room for a trial."""
    return [node for node in ray.nodes() if node["Alive"] and _fits(node["Resources"], placement)]


def _fits(resources: dict[str, float], placement: Placement) -> bool:
    return resources.get("CPU", 0.0) >= placement.cpus and resources.get("GPU", 0.0) >= placement.gpus


class WorkerPrestart(Callback):
    """Keeps enough idle processes waiting for the next trials, from the first training epoch of a started trial on.

    Not earlier, because on a machine with few cores the imports would slow down the start.
    """

    def __init__(
        self, placement: Placement, limit: int | None, waiting: Callable[[], int], say: Callable[[str], None]
    ) -> None:
        """
        Args:
            placement: resources of a trial.
            limit: number of trials at the same time, on all nodes.
            waiting: returns the number of trials that have not started yet.
            say: prints a line.
        """
        self._placement = placement
        self._limit = limit
        self._waiting = waiting
        self._say = say
        self._said: set[str] = set()
        self._probe: Any = None
        self._due = False

    def __getstate__(self) -> dict[str, Any]:
        # Ray pickles callbacks into its own state, which is never read back.
        return {}

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        self._due = True

    def on_trial_result(
        self, iteration: int, trials: list[Any], trial: Any, result: dict[str, Any], **info: Any
    ) -> None:
        waiting = self._waiting()
        if not self._due or not waiting:
            return
        try:
            self._due = not self._prestart(waiting)
        except Exception as error:  # any error: another version of Ray, or a dying node
            self._due, self._probe = False, None
            reason = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
            if reason not in self._said:
                self._said.add(reason)
                self._say(f"no process was started ahead of time, so trials start a few seconds later: {reason}")

    def _prestart(self, waiting: int) -> bool:
        """Start the processes needed; False while the trials' runtime environment is not known yet."""
        if self._probe is None:
            self._probe = _environment_of_trials()
        if not ray.wait([self._probe], timeout=0)[0]:
            return False
        environment = ray.get(self._probe)
        for node in nodes_for(self._placement):
            total = node["Resources"]
            at_once = self._placement.concurrent(total.get("GPU", 0.0), total.get("CPU", 1.0), self._limit)
            start_processes(node, min(at_once, waiting), environment)
        return True


def start_processes(node: dict[str, Any], count: int, environment: str) -> None:
    """Make a node's raylet keep `count` unused processes in its pool.

    Args:
        node: Ray's description of the node.
        count: number of processes, including those already waiting.
        environment: serialised runtime environment of the trials that will use them.

    Raises:
        Exception: any error of Ray's internals, such as grpc.RpcError if the node does not answer.
    """
    from ray._private.grpc_utils import init_grpc_channel
    from ray.core.generated import common_pb2, node_manager_pb2, node_manager_pb2_grpc

    request = node_manager_pb2.PrestartWorkersRequest(
        language=common_pb2.PYTHON,
        job_id=bytes.fromhex(ray.get_runtime_context().get_job_id()),
        keep_alive_duration_secs=KEEP_S,
        num_workers=count,
    )
    request.runtime_env_info.serialized_runtime_env = environment
    with init_grpc_channel(f"{node['NodeManagerAddress']}:{node['NodeManagerPort']}") as channel:
        node_manager_pb2_grpc.NodeManagerServiceStub(channel).PrestartWorkers(request, timeout=_CALL_LIMIT_S)


def _environment_of_trials() -> Any:
    """The trials' runtime environment, serialised: Tune merges its own over the Ray session's, and Ray only reuses
    processes with the same one."""
    from ray.tune.execution.class_cache import DEFAULT_ENV_VARS, ENV_VARS_TO_PROPAGATE

    variables = DEFAULT_ENV_VARS | {name: os.environ[name] for name in ENV_VARS_TO_PROPAGATE if name in os.environ}
    return ray.remote(_environment).options(num_cpus=0, runtime_env={"env_vars": variables}).remote()


def _environment() -> str:
    text: str = ray.get_runtime_context().get_runtime_env_string()
    return text
