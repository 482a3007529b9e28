"""Ray without the programs that only clusters, terminals and browsers need: half of what a start costs."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

from ray._private.node import Node


def _no_dashboard(node: Any, **_: Any) -> None:
    node._webui_url = ""


@contextmanager
def lean_ray(dashboard: bool = False) -> Iterator[None]:
    """A Ray that is started inside this block has no autoscaler and forwards no output; nor, unless `dashboard`, the
    server that would show it."""
    replaced: dict[str, Any] = {"start_monitor": lambda node: None, "start_log_monitor": lambda node: None}
    if not dashboard:
        replaced["start_api_server"] = _no_dashboard
    with mock.patch.multiple(Node, **replaced):
        yield
