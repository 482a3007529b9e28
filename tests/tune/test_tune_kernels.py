"""Whose kernels are compiled before the trials start."""

from typing import Any

from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune.driver import one_per_kernel_set


def test_each_algorithm_launches_kernels_of_its_own(make_space: Any) -> None:
    space = make_space(
        parameters={"algorithm.name": {"grid": ["ppo", "shac"]}, "trial.epochs": {"grid": [4, 5]}}, seeds="0-1"
    )
    representatives = one_per_kernel_set(resolve_trials(space))
    assert [trial.variant for trial in representatives] == ["algorithm=ppo, epochs=4", "algorithm=shac, epochs=4"]


def test_a_physics_setting_that_is_drawn_does_not_compile_for_each_trial(make_space: Any) -> None:
    space = make_space(
        parameters={
            "physics.substep_grad_clip": {"uniform": [1.0, 2.0]},
            "physics.integrator": {"grid": ["Euler", "implicitfast"]},
        },
        samples=3,
    )
    representatives = one_per_kernel_set(resolve_trials(space))
    assert [trial.config.physics.integrator for trial in representatives] == ["Euler", "implicitfast"]
