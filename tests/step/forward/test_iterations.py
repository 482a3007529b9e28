"""How many iterations the solver takes, by substep."""

import numpy as np
from scenes import ant

from msk_ray.step.forward import WorldBatch
from msk_ray.step.forward.iterations import limits_for, reached


def test_worlds_are_counted_in_the_substep_in_which_they_took_iterations() -> None:
    """Of three ants one slides on the ground, askew; the others hang in the air."""
    batch = WorldBatch(ant(), 3, 2, "cpu")
    qpos = np.tile(batch.mjm.qpos0, (3, 1)).astype(np.float32)
    qpos[:, 2] = (0.1, 5.0, 5.0)
    qpos[:, 4] = 0.2
    batch.data.qpos.assign(qpos)
    batch.data.qvel.assign(np.full((3, 14), 0.5, np.float32))
    batch.begin_step()
    taken = []
    for k in range(2):
        batch.launch_substep(batch.data, k)
        taken.append(batch.data.solver_niter.numpy().copy())
    counts = batch.iterations.read()
    assert len(set(taken[0])) > 1
    for row, iterations in zip(counts, taken, strict=True):
        assert row.tolist() == np.bincount(iterations, minlength=128).tolist()
    assert not batch.iterations.read().any()


def test_limits_are_what_few_worlds_reach() -> None:
    """Of 1000 worlds 100 take 4 iterations and 3 take 6 in the first substep; none takes any in the second."""
    counts = np.zeros((2, 128), int)
    counts[0, [1, 4, 6]] = 897, 100, 3
    counts[1, 0] = 1000
    assert limits_for(counts, 0.003) == (5, 1)
    assert limits_for(counts, 0.002) == (7, 1)
    assert reached(counts, (4, 1)) == (0.103, 0.0)
    assert limits_for(0 * counts, 0.003) == (1, 1)
    assert reached(0 * counts, (4, 1)) == (0.0, 0.0)
