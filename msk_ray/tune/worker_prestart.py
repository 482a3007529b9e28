"""Processes started ahead for the next trials, with everything imported: importing takes longer than all else a start
does.

Every trial still gets a process of its own. One that waits has not touched a GPU: CUDA is initialised when a trial
begins in it, on the GPU that trial was given. Ray has no public way to ask for such processes, so what is done here may
fail with another version of it. Then trials begin seconds later, which is said once, and nothing else changes.
"""

import importlib
import os
from collections.abc import Callable
from typing import Any

import ray
from ray.tune import Callback

from msk_ray.tune.devices import Placement

MODULES = ("msk_ray.training", "msk_ray.tune.trainable", "torch._dynamo")
"""What a trial's process imports; the last one when torch makes its first optimizer, for two seconds."""
KEEP_S = 24 * 3600
"""How long Ray keeps a process that has not been used [s]; those left over end with the driver."""
_CALL_LIMIT_S = 10.0


def import_all() -> None:
    """Run by every process of a trial as soon as it is there; what cannot be imported, the trial will say."""
    # Numerical libraries read it when they are imported; a trial sets its own number of threads (`trial.threads`).
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # threads that wait for work sleep rather than spin
    # CUDA reads it once, when it is initialised. Should an import do that, the trial is to fail without a GPU, not to
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
"""For the runtime environment of Ray's session."""


def nodes_for(placement: Placement) -> list[dict[str, Any]]:
    """Ray's description of every node alive that a trial fits on."""
    return [node for node in ray.nodes() if node["Alive"] and _fits(node["Resources"], placement)]


def _fits(resources: dict[str, float], placement: Placement) -> bool:
    return resources.get("CPU", 0.0) >= placement.cpus and resources.get("GPU", 0.0) >= placement.gpus


class WorkerPrestart(Callback):
    """Once a trial that has started trains, sees to it that as many processes wait as may be needed at once.

    Not at once when it starts: on a machine of few cores it would wait for those that import.
    """

    def __init__(
        self, placement: Placement, limit: int | None, waiting: Callable[[], int], say: Callable[[str], None]
    ) -> None:
        """
        Args:
            placement: of a trial.
            limit: trials at once, on all nodes.
            waiting: how many trials have not started yet.
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
        except Exception as error:  # whatever another version of Ray, or a node that dies this moment, makes of it
            self._due, self._probe = False, None
            reason = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
            if reason not in self._said:
                self._said.add(reason)
                self._say(f"no process was started ahead, so trials begin seconds later: {reason}")

    def _prestart(self, waiting: int) -> bool:
        """Start what may be needed at once; False while it is not known yet which environment trials have."""
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
    """Have a node's raylet see to it that `count` unused processes wait in its pool.

    Args:
        node: Ray's description of it.
        count: processes, those that wait already included.
        environment: serialised runtime environment of those who are to use them.

    Raises:
        Exception: as Ray's internals do; grpc.RpcError if the node does not answer.
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
    """A reference to it, serialised: Tune gives trials' processes a runtime environment of their own, laid over that of
    Ray's session, and Ray takes no process of another one."""
    from ray.tune.execution.class_cache import DEFAULT_ENV_VARS, ENV_VARS_TO_PROPAGATE

    variables = DEFAULT_ENV_VARS | {name: os.environ[name] for name in ENV_VARS_TO_PROPAGATE if name in os.environ}
    return ray.remote(_environment).options(num_cpus=0, runtime_env={"env_vars": variables}).remote()


def _environment() -> str:
    text: str = ray.get_runtime_context().get_runtime_env_string()
    return text
