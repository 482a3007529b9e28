"""When Ray counts as lost."""

import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from processes import wait_until

from msk_ray.errors import ClusterLost
from msk_ray.tune import ray_watch
from msk_ray.tune.ray_watch import RayWatch


class Ray:
    """Stands for Ray: how it answers can be changed."""

    def __init__(self) -> None:
        self.alive = True
        self.refusal: Exception | None = None
        self.frozen = threading.Event()
        self.frozen.set()
        self.dead: list[tuple[str, None]] = []
        self.asked = 0

    def nodes(self) -> list[dict[str, Any]]:
        self.frozen.wait()
        self.asked += 1
        if self.refusal is not None:
            raise self.refusal
        return [{"NodeID": "mine", "Alive": self.alive}, {"NodeID": "another", "Alive": False}]

    def get_runtime_context(self) -> Any:
        return SimpleNamespace(get_node_id=lambda: "mine")

    def dead_processes(self) -> list[tuple[str, None]]:
        return self.dead


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Iterator[Ray]:
    made = Ray()
    monkeypatch.setattr(ray_watch, "ray", made)
    monkeypatch.setattr(ray_watch, "global_worker", SimpleNamespace(node=made))
    monkeypatch.setattr(RayWatch, "INTERVAL_S", 0.01)
    yield made
    made.frozen.set()


def test_a_node_of_ones_own_that_has_died_is_lost(stand_in: Ray) -> None:
    with RayWatch() as watch:
        wait_until(lambda: stand_in.asked)
        assert watch.look(0.0) is None  # that of another machine does not matter
        stand_in.alive = False
        wait_until(lambda: watch.look(0.0))
        assert "has died" in str(watch.lost)
        assert watch.lost is not None
        assert watch.lost.exit_code == 75


def test_a_daemon_that_has_ended_is_named(stand_in: Ray) -> None:
    with RayWatch() as watch:
        stand_in.dead = [("dashboard", None)]
        assert watch.look(0.0) is None
        stand_in.dead.append(("gcs_server", None))
        assert "Ray's process gcs_server on this machine has died" in str(watch.look(0.0))


def test_silence_counts_until_there_is_an_answer(stand_in: Ray) -> None:
    with RayWatch() as watch:
        stand_in.frozen.clear()
        assert watch.look(RayWatch.LIMIT_S) is None
        stand_in.frozen.set()
        before = stand_in.asked
        wait_until(lambda: stand_in.asked > before + 1)
        stand_in.frozen.clear()
        assert watch.look(RayWatch.LIMIT_S - 1.0) is None
        assert "Ray has not answered for 40 s; continue with --resume" in str(watch.look(2.0))


def test_an_answer_that_is_an_error_is_none(stand_in: Ray) -> None:
    stand_in.refusal = RuntimeError("unreachable")
    with RayWatch() as watch:
        wait_until(lambda: stand_in.asked)
        assert "Ray has not answered for 40 s (unreachable)" in str(watch.look(RayWatch.LIMIT_S + 1.0))


def test_nobody_writes_once_it_is_lost(stand_in: Ray) -> None:
    called: list[bool] = []
    with RayWatch() as watch:
        check = watch.guarding(lambda: called.append(True))
        check()
        stand_in.dead = [("raylet", None)]
        watch.look(0.0)
        with pytest.raises(ClusterLost):
            check()
    assert called == [True]
