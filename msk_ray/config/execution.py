"""How a trial is computed, as opposed to what it computes: devices, kernels, buffers, files. Not part of its id."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from msk_ray.config.loggers import LOGGERS
from msk_ray.config.sections import SHOWN, Count, Section, Text
from msk_ray.errors import ConfigError


def _off(value: Any) -> Any:
    """In YAML, a bare `off` is false."""
    return "off" if value is False else value


class ExecutionConfig(Section):
    """How a trial is computed. Results differ by rounding at most; what is trained is the same."""

    gpus: Annotated[int, Field(ge=1, le=64)] = 1
    """Number of GPUs of one host that share the worlds, with one process each; on the CPU, number of processes. It must
    divide `env.nworld`."""
    threads: Count = 1
    """Number of torch's CPU threads. It changes rounding, so it comes from this setting and never from the machine.
    Networks of a few hundred units gain nothing from more than one."""
    deterministic: bool = False
    """Add everything up in a fixed order, so that a GPU repeats the trial bit for bit (docs/runner/repeat.md)."""
    solver_kernels: Literal["mujoco_warp", "fused", "auto"] = "mujoco_warp"
    """Kernels of the constraint solver. `fused` runs all of Newton's iterations in one kernel, with a warp per world:
    for models of up to 60 degrees of freedom. `auto` takes it for such models with room for up to 256 constraint rows
    per world, mujoco_warp's own for others; `train` says which."""
    jacobian: Literal["dense", "sparse"] | None = None
    """How mujoco_warp stores the constraint Jacobian; null: as the model says. Which is faster and smaller on a GPU
    depends on the model."""
    nconmax: Count | None = None
    """Contacts per world. null: a bound from the geometry or, if that is large, the result of a short probe, which
    grows when needed. A given number does not grow."""
    njmax: Count | None = None
    """Constraint rows per world; null: as for nconmax."""
    capture: Annotated[Literal["auto", "off", False], AfterValidator(_off)] = "auto"
    """`auto`: on CUDA, record epochs as graphs and replay them; an environment that makes the host wait for the device
    runs operation by operation instead, with a warning that says where. `off`: never record, to debug."""
    checkpoint_interval: Count = 10
    """Epochs between checkpoints."""
    keep_checkpoints: Annotated[int, Field(ge=2)] = 2
    """Number of newest checkpoints to keep, in addition to the best."""
    loggers: Annotated[tuple[Text, ...], Field(max_length=16)] = ("tensorboard",)
    """Loggers in addition to `metrics.jsonl`: `tensorboard`, `wandb`, `mlflow`, or package.module:Class."""

    @field_validator("loggers")
    @classmethod
    def _known_loggers(cls, names: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        if info.context == SHOWN:
            return names
        try:
            for name in names:
                LOGGERS.path(name)
        except ConfigError as error:
            raise ValueError(str(error)) from error
        return names

    @model_validator(mode="after")
    def _fused_solver_is_dense(self) -> "ExecutionConfig":
        if self.solver_kernels == "fused" and self.jacobian == "sparse":
            raise ValueError("solver_kernels fused reads dense Jacobians: leave execution.jacobian out")
        return self

    def check_integrator(self, integrator: str | None) -> None:
        """Refuse an integrator that these settings do not support.

        Raises:
            ValueError: the message says what to write instead.
        """
        if integrator != "RK4":
            return
        if self.solver_kernels == "fused":
            raise ValueError(
                "solver_kernels fused is for one solve a step: write physics.integrator: Euler or implicitfast, or "
                "execution.solver_kernels: mujoco_warp"
            )

    def check_order(self, integrator: str | None) -> None:
        """Refuse settings that are incompatible with `deterministic`, because they leave sums without a fixed order.

        Raises:
            ValueError: the message says what to write instead.
        """
        if not self.deterministic:
            return
        wrong = {
            "execution.gpus": (self.gpus > 1, "1"),
            "execution.jacobian": (self.jacobian == "sparse", "dense"),
            "physics.integrator": (integrator == "RK4", "Euler or implicitfast"),
        }
        for key, (unordered, write) in wrong.items():
            if unordered:
                raise ValueError(
                    f"execution.deterministic: with this {key} sums have no fixed order; write {key}: {write}, or "
                    "execution.deterministic: false"
                )


AS_USUAL = ExecutionConfig()
"""The defaults: one process, mujoco_warp's kernels."""
