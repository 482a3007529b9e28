"""Which terms of a reward have a gradient, whatever operations put them together."""

import sys
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from msk_ray.envs.cut_gradients import terms_without_gradient

SPEED = torch.tensor((0.5, -1.0, 0.0, 2.0))


def columns(first: Tensor, second: Tensor) -> Tensor:
    terms = torch.zeros(4, 2)
    terms[:, 0] = first
    terms[:, 1] = second
    return terms


TOGETHER: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "stacked": lambda first, second: torch.stack((first, second), -1),
    "weighted, one of them by 0": lambda first, second: torch.stack((first, second)).T * torch.tensor((2.0, 0.0)),
    "joined": lambda first, second: -torch.cat((first[:, None], second[:, None]), -1) / 3.0,
    "written into columns": columns,
    "extended": lambda first, second: torch.cat((torch.stack((first,), -1), second.unsqueeze(-1)), -1).clone(),
}
CUT: dict[str, Callable[[Tensor], Tensor]] = {
    "detached": lambda x: x.square().detach(),
    "a comparison": lambda x: (x > 0.0).float(),
    "numpy": lambda x: torch.from_numpy(x.detach().numpy() ** 2),
    "a constant": torch.ones_like,
}
FLAT: dict[str, Callable[[Tensor], Tensor]] = {
    "beyond a bound": lambda x: torch.relu(x - 1e6).square(),
    "clamped": lambda x: x.clamp(5.0, 6.0),
    "masked": lambda x: (x > 1e6) * x.square(),
    "not chosen": lambda x: torch.where(x > 1e6, x, 0.0),
    "weighted by 0": lambda x: 0.0 * x,
    "at an extreme": lambda x: (x - x.detach()).square(),
    "partly cut": lambda x: x + x.detach(),
}


@pytest.mark.parametrize("together", TOGETHER.values(), ids=list(TOGETHER))
@pytest.mark.parametrize(
    ("term", "cut"),
    [*((term, True) for term in CUT.values()), *((term, False) for term in FLAT.values())],
    ids=[*CUT, *FLAT],
)
def test_a_term_is_cut_where_it_can_have_no_gradient_and_not_where_it_is_0(
    term: Callable[[Tensor], Tensor], cut: bool, together: Callable[[Tensor, Tensor], Tensor]
) -> None:
    speed = SPEED.clone().requires_grad_().clone()
    effort = -speed.square()
    assert terms_without_gradient(together(term(speed), effort)) == [0] * cut
    assert terms_without_gradient(together(effort, term(speed))) == [1] * cut


def test_all_terms_are_cut_where_nothing_has_a_gradient() -> None:
    assert terms_without_gradient(torch.zeros(4, 3)) == [0, 1, 2]


def test_terms_that_are_a_product_of_the_observation_have_its_gradient() -> None:
    obs = torch.ones(4, 5, requires_grad=True)
    weights = torch.zeros(5, 2)
    weights[0, 0] = 1.0
    assert terms_without_gradient(torch.addmm(torch.zeros(2), obs, weights)) == []


def test_asking_does_not_load_what_takes_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.fx.experimental.symbolic_shapes", None)  # importing it raises
    x = torch.ones(4, requires_grad=True)
    assert terms_without_gradient(torch.stack([2.0 * x, torch.ones(4)], dim=1)) == [1]
