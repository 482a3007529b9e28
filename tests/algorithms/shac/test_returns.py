"""Returns by numbers worked out by hand."""

import torch

from msk_ray.algorithms.shac.returns import actor_loss, discounts, td_lambda_targets


def column(*values: float | bool) -> torch.Tensor:
    return torch.tensor(values)[:, None]


REWARDS = column(1.0, 2.0, 3.0)
VALUES = column(10.0, 20.0, 30.0)
NEVER = column(False, False, False)


def test_discounts_restart_after_an_end() -> None:
    done = column(False, True, False, False)
    assert torch.allclose(discounts(done, 0.5), column(1.0, 0.5, 1.0, 0.5))


def test_actor_loss_bootstraps_at_the_horizon() -> None:
    # −(1 + 0.5·2 + 0.25·3 + 0.125·30) / 3 = −6.5 / 3
    assert torch.isclose(actor_loss(REWARDS, VALUES, NEVER, NEVER, 0.5), torch.tensor(-6.5 / 3))


def test_actor_loss_bootstraps_at_a_truncation_and_starts_anew() -> None:
    done = column(False, True, False)
    # first piece: 1 + 0.5·2 + 0.25·20 = 7; second: 3 + 0.5·30 = 18
    assert torch.isclose(actor_loss(REWARDS, VALUES, NEVER, done, 0.5), torch.tensor(-25.0 / 3))


def test_actor_loss_gives_a_terminated_state_no_value() -> None:
    done = column(False, True, False)
    # first piece: 1 + 0.5·2 = 2; second: 18
    assert torch.isclose(actor_loss(REWARDS, VALUES, done, done, 0.5), torch.tensor(-20.0 / 3))


def test_a_value_that_is_not_finite_after_termination_leaves_loss_and_gradient_alone() -> None:
    values = column(10.0, float("nan"), 30.0).requires_grad_()
    done = column(False, True, False)
    loss = actor_loss(REWARDS, values, done, done, 0.5)
    loss.backward()
    assert torch.isclose(loss, torch.tensor(-20.0 / 3))
    assert torch.allclose(values.grad, column(0.0, 0.0, -0.5 / 3))


def test_td_lambda_between_its_extremes() -> None:
    # γ = 0.5. λ = 0 is one-step: 1 + 5, 2 + 10, 3 + 15. λ = 1 is Monte Carlo: 3 + 15 = 18, 2 + 9 = 11, 1 + 5.5 = 6.5.
    one_step = column(6.0, 12.0, 18.0)
    assert torch.allclose(td_lambda_targets(REWARDS, VALUES, NEVER, NEVER, 0.5, 0.0), one_step)
    assert torch.allclose(td_lambda_targets(REWARDS, VALUES, NEVER, NEVER, 0.5, 1.0), column(6.5, 11.0, 18.0))
    # λ = ½: G₂ = 18; G₁ = 2 + ½(½·20 + ½·18) = 11.5; G₀ = 1 + ½(½·10 + ½·11.5) = 6.375
    assert torch.allclose(td_lambda_targets(REWARDS, VALUES, NEVER, NEVER, 0.5, 0.5), column(6.375, 11.5, 18.0))


def test_td_lambda_tells_truncation_from_termination() -> None:
    done = column(False, True, False)
    # truncated at 1: G₁ = 2 + ½·20 = 12, G₀ = 1 + ½(½·10 + ½·12) = 6.5
    assert torch.allclose(td_lambda_targets(REWARDS, VALUES, NEVER, done, 0.5, 0.5), column(6.5, 12.0, 18.0))
    # terminated at 1: G₁ = 2, G₀ = 1 + ½(½·10 + ½·2) = 4
    assert torch.allclose(td_lambda_targets(REWARDS, VALUES, done, done, 0.5, 0.5), column(4.0, 2.0, 18.0))
