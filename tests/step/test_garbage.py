"""Collections put off, and those that leave imports alone."""

import gc
import subprocess
import sys

import pytest
from needs import slow

from msk_ray.step.garbage import lasting_imports, without_collecting


def test_nothing_is_collected_within_even_after_an_error() -> None:
    def work() -> None:
        with without_collecting():
            assert not gc.isenabled()
        assert not gc.isenabled()
        raise RuntimeError

    with pytest.raises(RuntimeError), without_collecting():
        work()
    assert gc.isenabled()


def test_what_imports_make_is_never_looked_at_again() -> None:
    gc.unfreeze()
    with lasting_imports():
        assert not gc.isenabled()
        made = [[] for _ in range(1000)]
    assert gc.isenabled()
    assert gc.get_freeze_count() > len(made)
    gc.unfreeze()


def test_who_collects_nothing_keeps_that() -> None:
    gc.unfreeze()
    with without_collecting():
        with lasting_imports():
            pass
        assert not gc.isenabled()
    assert gc.get_freeze_count() == 0


@pytest.mark.long
@pytest.mark.parametrize("package", ["msk_ray.training", *slow("msk_ray.step.autograd")])
def test_kernels_are_imported_so(package: str) -> None:
    code = f"import gc, {package}; print(gc.isenabled(), gc.get_freeze_count() > 200_000)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "True True\n"
