"""Running out of memory has a name."""

import pickle

import pytest
import torch

from msk_ray.errors import Failure, SimulationError
from msk_ray.training.named_out_of_memory import named_out_of_memory


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nMore lines"),
        RuntimeError("Failed to allocate 8589934592 bytes on device 'cuda:0'"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:1] DefaultCPUAllocator: can't allocate memory: you tried"),
        MemoryError(),
    ],
)
def test_a_failed_allocation_names_the_setting_to_lower(error: Exception) -> None:
    advice = r"too little memory for 64 worlds; lower env\.nworld or ppo\.steps \("
    with (
        pytest.raises(SimulationError, match=advice) as caught,
        named_out_of_memory("cpu", 64, "env.nworld", "ppo.steps"),
    ):
        raise error
    assert caught.value.failure is Failure.OUT_OF_MEMORY
    assert "\n" not in str(caught.value)
    # It crosses from the trial's process to the driver.
    assert pickle.loads(pickle.dumps(caught.value)).failure is Failure.OUT_OF_MEMORY


def test_torch_itself_is_understood() -> None:
    with (
        pytest.raises(SimulationError, match="out_of_memory: cpu"),
        named_out_of_memory("cpu", 64, "env.nworld", "ppo.steps"),
    ):
        torch.empty(2**55)


def test_other_errors_pass() -> None:
    with pytest.raises(RuntimeError, match="shapes"), named_out_of_memory("cpu", 64, "env.nworld", "ppo.steps"):
        raise RuntimeError("shapes do not match")
