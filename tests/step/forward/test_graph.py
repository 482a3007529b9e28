"""Recorded launches: the first run counts, the second is the first that is recorded."""

import warp as wp

from msk_ray.step.forward import Graph


def test_on_a_cpu_work_is_recorded_when_it_is_done_a_second_time() -> None:
    source, goal = (wp.zeros(2, dtype=wp.float32, device="cpu") for _ in range(2))
    calls: list[float] = []

    def launches() -> None:
        calls.append(float(source.numpy()[0]))
        wp.copy(goal, source)

    graph = Graph(launches, wp.get_device("cpu"))
    for value in (1.0, 2.0, 3.0, 4.0):
        source.assign([value, value])
        goal.fill_(-1.0)
        graph.replay()
        assert goal.numpy().tolist() == [value, value]
    assert calls == [0.0, 1.0, 2.0]  # gone through for its kernels, run as it is, recorded; the others are replays
