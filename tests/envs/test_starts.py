"""What episodes begin with: the columns of their numbers, the stock, and shares of a group."""

import torch
from torch import Tensor

from msk_ray.envs.starts import Starts
from msk_ray.group import ALONE, Group
from msk_ray.step import StepState

WORLDS = 2


class Die:
    """Draws the numbers 1, 2, 3, ... times ten."""

    size = 1

    def __init__(self) -> None:
        self.generator = torch.Generator()
        self.seed(0)

    def draw(self, count: int) -> Tensor:
        self.last += count
        return 10.0 * torch.arange(self.last - count + 1, self.last + 1)[:, None]

    def seed(self, seed: int) -> None:
        self.last = seed


class Second(Group):
    """The second of two processes."""

    rank = 1
    size = 2

    def own(self, whole: Tensor, dim: int = 0) -> Tensor:
        return whole.chunk(2, dim)[1]


def states(count: int) -> tuple[StepState, Tensor]:
    """States 0, 1, 2, ..., each with one number of its task and two draws of a command."""
    qpos = torch.arange(float(count))[:, None]
    return StepState(qpos, qpos, torch.zeros(count, 0)), torch.cat((100.0 + qpos, -qpos, -qpos), -1)


def starts() -> Starts:
    return Starts(states, {"randomizer": None, "disturbances": Die()}, 2, WORLDS)


def test_the_numbers_of_an_episode_are_told_apart() -> None:
    drawn = starts().draw(3)
    parts = starts().split(drawn.numbers)
    assert list(parts) == ["disturbances", "task", "commands"]
    assert parts["disturbances"].tolist() == [[10.0], [20.0], [30.0]]
    assert parts["task"].tolist() == [[100.0], [101.0], [102.0]]
    assert parts["commands"].tolist() == [[0.0, 0.0], [-1.0, -1.0], [-2.0, -2.0]]


def test_a_stock_lasts_for_its_steps_and_then_each_is_drawn() -> None:
    drawing = starts()
    drawing.stock(drawing.draw_steps(2, ALONE))
    taken = [drawing.take(ALONE) for _ in range(3)]
    assert sorted(float(each.numbers[0, 0]) for each in taken[:2]) == [10.0, 30.0]
    assert taken[2].numbers[:, 0].tolist() == [50.0, 60.0]
    drawing.stock(drawing.draw_steps(1, ALONE))
    drawing.stock(None)
    assert drawing.take(ALONE).numbers[:, 0].tolist() == [90.0, 100.0]


def test_a_process_keeps_what_its_own_worlds_begin_with() -> None:
    drawn = starts().draw_steps(2, Second())
    assert drawn.physics.qpos[:, 0].tolist() == [2.0, 3.0, 6.0, 7.0]
    assert drawn.numbers[:, 0].tolist() == [30.0, 40.0, 70.0, 80.0]


def test_saved_numbers_are_read_back() -> None:
    numbers = starts().draw(WORLDS).numbers
    saved = starts().state_dict(numbers, ALONE)
    assert saved["randomizer"] is None
    assert torch.equal(starts().load_state_dict(saved, ALONE, torch.device("cpu")), numbers)
