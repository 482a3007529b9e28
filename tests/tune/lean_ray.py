"""Ray without what only clusters, terminals, browsers and telemetry need: a third of what a start costs."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

from ray._private.node import Node


def _no_dashboard(node: Any, **_: Any) -> None:
    node._webui_url = ""


@contextmanager
def lean_ray(dashboard: bool = False) -> Iterator[None]:
    """A Ray that is started inside this block has no autoscaler, forwards no output, starts no process before one is
    needed, and counts no loggers for telemetry, for which it would load those that are installed; nor, unless
    `dashboard`, has it the server that would show it."""
    replaced: dict[str, Any] = {"start_monitor": lambda node: None, "start_log_monitor": lambda node: None}
    with ExitStack() as stack:
        if not dashboard:
            replaced["start_api_server"] = _no_dashboard
        stack.enter_context(mock.patch.multiple(Node, **replaced))
        stack.enter_context(mock.patch.dict(os.environ, RAY_prestart_worker_first_driver="0"))
        stack.enter_context(mock.patch("ray.air._internal.usage.tag_callbacks"))
        yield
