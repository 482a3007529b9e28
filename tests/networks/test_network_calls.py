"""Calls of a network whose gradients are added up at once."""

import torch

from msk_ray.algorithms.shac.half_batch_cosine import HalfBatchCosine
from msk_ray.config.schema import ActorConfig
from msk_ray.networks import Actor
from msk_ray.networks.network_calls import NetworkCalls


def rollout(actor: Actor) -> torch.Tensor:
    """Three actions, each of which the next observation depends on; the fourth has no part in the result."""
    obs = torch.linspace(-1.0, 1.0, 12).view(4, 3)
    total = torch.zeros(())
    for step in range(4):
        action = actor(obs, torch.full((4, 2), 0.1 * step))
        obs = obs.roll(1, dims=1) + action.sum(-1, keepdim=True)
        total = total + obs.square().mean() if step < 3 else total
    return total


def test_gradients_and_the_halves_cosine_are_those_of_autograd() -> None:
    gradients, cosines, totals = [], [], []
    for together in (True, False):
        actor = Actor(ActorConfig(hidden=(6, 5)), 3, 2, torch.Generator().manual_seed(0))
        calls = [NetworkCalls(actor.mean)] if together else []
        halves = HalfBatchCosine(actor, calls=calls)
        with halves.watching():
            if together:
                with calls[0].recording():
                    total = rollout(actor)
            else:
                total = rollout(actor)
        total.backward()
        if together:
            assert actor.mean[0].weight.grad is None
            calls[0].add_gradients()
        gradients.append([p.grad for p in actor.parameters()])
        cosines.append(halves.cosine())
        totals.append(total.detach())
    torch.testing.assert_close(*gradients)
    torch.testing.assert_close(*cosines)
    assert torch.equal(*totals)


def test_a_network_is_itself_again_afterwards() -> None:
    actor = Actor(ActorConfig(hidden=(6,)), 3, 2, torch.Generator().manual_seed(0))
    calls = NetworkCalls(actor.mean)
    with calls.recording():
        pass
    actor(torch.ones(4, 3)).sum().backward()
    assert actor.mean[0].weight.grad is not None
    before = [p.grad for p in actor.mean.parameters()]
    calls.add_gradients()  # there were none
    assert [p.grad for p in actor.mean.parameters()] == before
