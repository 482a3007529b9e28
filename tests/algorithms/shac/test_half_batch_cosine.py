import pytest
import torch

from msk_ray.algorithms.shac.half_batch_cosine import HalfBatchCosine
from msk_ray.group import Group


def network() -> torch.nn.Sequential:
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(3, 5), torch.nn.Tanh(), torch.nn.Linear(5, 2))


def test_the_cosine_is_that_of_two_separate_backward_passes() -> None:
    net = network()
    steps = [torch.randn(8, 3) for _ in range(4)]

    def loss_of(worlds: slice) -> torch.Tensor:
        return sum((net(x)[worlds].sin().sum() for x in steps), torch.zeros(()))

    weights = [net[0].weight, net[2].weight]
    halves = [
        torch.cat([g.flatten() for g in torch.autograd.grad(loss_of(w), weights)]) for w in (slice(0, 4), slice(4, 8))
    ]
    expected = torch.nn.functional.cosine_similarity(*halves, dim=0)

    watch = HalfBatchCosine(net)
    with watch.watching():
        loss = loss_of(slice(0, 8))
    loss.backward()
    torch.testing.assert_close(watch.cosine(), expected)


def test_equal_worlds_agree_and_opposite_ones_do_not() -> None:
    net = network()
    for sign, cosine in ((1.0, 1.0), (-1.0, -1.0)):
        watch = HalfBatchCosine(net)
        with watch.watching():
            out = net(torch.ones(4, 3))
        (out * torch.tensor([1.0, 1.0, sign, sign])[:, None]).sum().backward()
        torch.testing.assert_close(watch.cosine(), torch.tensor(cosine))


@pytest.mark.parametrize(("nworld", "size"), [(4, 2), (4, 3), (1, 5), (3, 3)])
def test_the_halves_are_of_the_worlds_of_all_processes(nworld: int, size: int) -> None:
    """As many as one process would put into each; of an odd number the last is left out."""
    halves: tuple[list[int], list[int]] = ([], [])
    for rank in range(size):
        group = Group()
        group.rank, group.size = rank, size
        own = range(rank * nworld, (rank + 1) * nworld)
        for half, part in zip(halves, HalfBatchCosine(network(), group)._parts(nworld), strict=True):
            half.extend(own[part])
    half = nworld * size // 2
    assert halves == (list(range(half)), list(range(half, 2 * half)))
