"""Adam whose state is restored in the same memory."""

import copy

import pytest
import torch
from torch import nn

from msk_ray.algorithms.shac.optimizer import RateAdam, clip_gradients


def stepped(parameter: nn.Parameter, adam: RateAdam, gradients: list[float]) -> None:
    for gradient in gradients:
        parameter.grad = torch.full_like(parameter, gradient)
        adam.step()


def test_a_restored_optimiser_goes_on_as_before_and_in_the_same_memory() -> None:
    parameter = nn.Parameter(torch.zeros(3))
    adam = RateAdam([parameter], 0.1, (0.9, 0.99))
    stepped(parameter, adam, [1.0, 2.0])
    state, weights = copy.deepcopy(adam.state_dict()), parameter.detach().clone()
    memory = [value.data_ptr() for value in adam.state_dict()["state"][0].values()]
    stepped(parameter, adam, [3.0, -1.0])
    expected = parameter.detach().clone()
    adam.load_state_dict(state)
    with torch.no_grad():
        parameter.copy_(weights)
    assert [value.data_ptr() for value in adam.state_dict()["state"][0].values()] == memory
    stepped(parameter, adam, [3.0, -1.0])
    assert torch.equal(parameter, expected)
    # A fresh one too, which has no moments yet.
    other = nn.Parameter(weights.clone())
    fresh = RateAdam([other], 0.5, (0.9, 0.99))
    fresh.load_state_dict(state)
    fresh.set_rate(0.1)
    stepped(other, fresh, [3.0, -1.0])
    assert torch.equal(other, expected)


@pytest.mark.parametrize("decay", [0.0, 0.5])
def test_it_does_what_torchs_adam_does_and_goes_on_from_its_state(decay: float) -> None:
    """Also from a state before the first step, which has no entries."""
    theirs, ours = (nn.Parameter(torch.linspace(-1.0, 1.0, 5)) for _ in range(2))
    torchs = torch.optim.AdamW([theirs], 0.1, (0.7, 0.95), weight_decay=decay)
    for step in range(6):
        if step in (0, 3):
            adam = RateAdam([ours], 0.1, (0.7, 0.95), decay)
            adam.load_state_dict(copy.deepcopy(torchs.state_dict()))
        gradient = torch.sin(torch.arange(5.0) + step)
        theirs.grad, ours.grad = gradient.clone(), gradient.clone()
        torchs.step()
        adam.step(skip=torch.tensor(False))
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-7)
    adam.zero_grad()
    adam.step()
    torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(("skip", "moved"), [(True, 0.0), (False, -0.1)])
def test_a_step_is_left_out_if_asked(skip: bool, moved: float) -> None:
    parameter = nn.Parameter(torch.zeros(1))
    adam = RateAdam([parameter], 0.1, (0.9, 0.99))
    parameter.grad = torch.ones(1)
    adam.step(skip=torch.tensor(skip))
    assert parameter.item() == pytest.approx(moved, abs=1e-6)


def test_pieces_of_parameters_are_stepped_like_the_whole() -> None:
    """As on a GPU, where each piece has a block of threads of its own."""
    whole, parts = ([nn.Parameter(torch.linspace(-1.0, 1.0, 6).view(2, 3)), nn.Parameter(torch.ones(1))] for _ in "ab")
    adams = [RateAdam(parameters, 0.1, (0.7, 0.95), 0.1) for parameters in (whole, parts)]
    adams[1]._piece = 4
    for step in range(3):
        for parameters, adam in zip((whole, parts), adams, strict=True):
            parameters[0].grad = torch.cos(torch.arange(6.0) + step).view(3, 2).T
            parameters[1].grad = None if step == 1 else torch.ones(1)
            adam.step(skip=torch.tensor(step == 2))
    assert all(torch.equal(a, b) for a, b in zip(whole, parts, strict=True))


@pytest.mark.parametrize("limit", [0.5, 100.0, float("inf")])
def test_gradients_clipped_in_one_tensor_are_those_that_torch_clips(limit: float) -> None:
    """The third parameter has none."""
    theirs, ours = ([nn.Parameter(torch.zeros(size)) for size in ((2, 3), (4,), (1,))] for _ in "ab")
    for parameters in (theirs, ours):
        parameters[0].grad = torch.arange(6.0).view(3, 2).T
        parameters[1].grad = torch.tensor([0.5, -2.0, 0.0, 1.0])
    expected = nn.utils.clip_grad_norm_(theirs, limit)
    assert torch.isclose(clip_gradients(ours, limit), expected)
    for a, b in zip(ours[:2], theirs[:2], strict=True):
        torch.testing.assert_close(a.grad, b.grad)
    assert ours[2].grad is None
