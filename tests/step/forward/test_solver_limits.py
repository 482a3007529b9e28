"""Limits of the constraint solver: high enough to converge, unless somebody asks for less."""

import warnings

import mujoco
import pytest

from msk_ray.errors import ConfigError
from msk_ray.step.forward import Kernels, WorldBatch
from msk_ray.step.forward.solver_limits import SolverLimits


def _model(options: str, geom: str = 'size=".1"') -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option {options}/><worldbody><geom type="plane" size="1 1 1"/>'
        f'<body pos="0 0 .09"><freejoint/><geom mass="1" {geom}/></body></worldbody></mujoco>'
    )


def _limits(batch: WorldBatch) -> SolverLimits:
    return SolverLimits(batch.model.opt.iterations, batch.model.opt.ls_iterations)


def test_a_solver_that_stops_early_gets_more_iterations_and_says_so() -> None:
    said = (
        r"iterations 100 instead of 1 and ls_iterations 50 instead of 5; to keep the model's own, write "
        r"physics\.iterations: 1 and physics\.ls_iterations: 5 in a config, kernels=Kernels\(iterations=1, "
        r"ls_iterations=5\) in Python, --iterations 1 --ls-iterations 5 in gradcheck"
    )
    model = _model('iterations="1" ls_iterations="5"')
    with pytest.warns(UserWarning, match=said) as found:
        batch = WorldBatch(model, 1, 1, "cpu")
    assert len(found) == 1
    assert _limits(batch) == batch.limits == SolverLimits(100, 50)
    assert (model.opt.iterations, model.opt.ls_iterations) == (1, 5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert _limits(batch.resized(2)) == SolverLimits(100, 50)
        assert _limits(batch.with_parameters(["body_mass"])) == SolverLimits(100, 50)


def test_only_what_is_too_low_is_raised() -> None:
    with pytest.warns(
        UserWarning, match=r"it runs with ls_iterations 50 instead of 5; .* physics\.ls_iterations: 5 in"
    ):
        batch = WorldBatch(_model('iterations="300" ls_iterations="5"'), 1, 1, "cpu")
    assert _limits(batch) == SolverLimits(300, 50)


@pytest.mark.parametrize(
    ("options", "geom", "given", "expected"),
    [
        ("", 'size=".1"', {}, (100, 50)),
        ('iterations="1" ls_iterations="5"', 'size=".1"', {"iterations": 1, "ls_iterations": 5}, (1, 5)),
        ("", 'size=".1"', {"iterations": 3, "ls_iterations": 4}, (3, 4)),
        ('iterations="1" ls_iterations="5"', 'size=".1" contype="0" conaffinity="0"', {}, (100, 50)),
    ],
    ids=["enough", "kept", "fewer", "nothing to solve"],
)
def test_nothing_is_said_of_limits_that_are_meant_or_without_effect(
    options: str, geom: str, given: dict[str, int], expected: tuple[int, int]
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert _limits(WorldBatch(_model(options, geom), 1, 1, "cpu", kernels=Kernels(**given))) == expected


@pytest.mark.parametrize("name", ["iterations", "ls_iterations"])
def test_a_limit_below_one_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"{name} must be at least 1, not 0"):
        WorldBatch(_model(""), 1, 1, "cpu", kernels=Kernels(**{name: 0}))
