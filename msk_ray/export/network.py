"""An exported policy: from raw observations to actions and controls, in one network.

Axes: N observations, O observation, A action, U controls.
"""

import io
import logging
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from msk_ray.envs import Env
from msk_ray.envs.records import EnvState
from msk_ray.errors import ExportError
from msk_ray.export.find_memory import NOISE, carried_memory
from msk_ray.step import StepState

Runner = Callable[..., list[Tensor]]
"""Runs an exported policy on its inputs."""


class CarriedInput(NamedTuple):
    """An input that is an output of the call before."""

    name: str
    output: str
    start: Tensor
    """Its value in the first call of an episode, (size,)."""


class PolicyToControl(nn.Module):
    """Observations (N, O) to actions (N, A) in [-1, 1] and, unless they depend on the state, controls (N, U).

    If controls depend on the previous action, that is a further input (N, A). So are the memories that it carries, each
    (N, size), which are also outputs, for the next call; entries of the observation that show them are not given. The
    normalisation of the observation and the squashing of the action are inside.

    Attributes:
        network: from whole observations to actions.
        memory: the memories that it carries.
        remarks: what the file cannot do for the environment's memories.

    Raises:
        ExportError: the environment's `control` only works for one action per world.
    """

    def __init__(self, network: nn.Module, env: Env[Any]) -> None:
        super().__init__()
        if env.nworld < 2:
            raise ValueError("several worlds are needed to compare their controls")
        self.network = network
        self._env = env
        self.remarks: list[str] = []
        self.gives_control = not _depends_on_state(env)
        read = _read_by_control(env) if self.gives_control else set()
        self.memory = carried_memory(env, read)
        if lost := read - set(self.memory.start):
            self.gives_control = False
            self.memory = carried_memory(env, set())
            self.remarks.append(f"no ctrl: `control` reads {_quoted(lost)}, which the file cannot carry")
        if self.memory.outside:
            self.remarks.append(
                f"entries of obs show {_quoted(self.memory.outside)}, which the file cannot carry: your program has to "
                "keep it and pass these entries"
            )
        self._sizes = [len(start) for start in self.memory.start.values()]
        self._order = torch.tensor([*self.memory.given, *self.memory.shown]).argsort()
        self.takes_previous = self.gives_control and _depends_on_previous(env)
        if self.gives_control:
            self._try_control()

    @property
    def carried(self) -> list[CarriedInput]:
        """Its inputs besides the observation."""
        previous = CarriedInput("previous_action", "action", torch.zeros(self._env.action_size))
        memories = [
            CarriedInput(f"memory_{name}", f"next_memory_{name}", start) for name, start in self.memory.start.items()
        ]
        return [previous, *memories] if self.takes_previous else memories

    @property
    def inputs(self) -> list[str]:
        """Names of its inputs."""
        return ["obs", *(carried.name for carried in self.carried)]

    @property
    def outputs(self) -> list[str]:
        """Names of its outputs."""
        control = ["ctrl"] if self.gives_control else []
        return ["action", *control, *(carried.output for carried in self.carried if carried.output != "action")]

    def forward(self, obs: Tensor, *carried: Tensor) -> tuple[Tensor, ...]:
        memories = carried[1:] if self.takes_previous else carried
        remembered = torch.cat((*memories, obs[:, :0]), -1)
        whole = obs
        if self.memory.shown:
            whole = torch.cat((obs, self.memory.fill(remembered)), -1)[:, self._order]
        action = self.network(whole)
        outputs = (action, self._control(action, *carried)) if self.gives_control else (action,)
        if not memories:
            return outputs
        after = self.memory.update(torch.cat((remembered, obs, action), -1))
        return (*outputs, *after.split(self._sizes, -1))

    def given(self, obs: Tensor) -> Tensor:
        """The entries (N, ...) of observations (N, O) that are its input."""
        return obs[:, list(self.memory.given)] if self.memory.shown else obs

    def examples(self, obs: Tensor, seed: int) -> tuple[Tensor, ...]:
        """Its inputs for some observations, with random other ones."""
        generator = torch.Generator().manual_seed(seed)
        shapes = [(len(obs), len(carried.start)) for carried in self.carried]
        return self.given(obs), *(2.0 * torch.rand(shape, generator=generator) - 1.0 for shape in shapes)

    def _control(self, action: Tensor, *carried: Tensor) -> Tensor:
        state = self._env.state
        if self.takes_previous:
            state, carried = state._replace(action=carried[0]), carried[1:]
        memory = {**state.memory, **dict(zip(self.memory.start, carried, strict=True))}
        with self._env.in_state(state._replace(memory=memory)):
            return self._env.control(action)

    def _try_control(self) -> None:
        """Try `control` on one action, and on more actions than there are worlds."""
        for count in (1, self._env.nworld + 1):
            actions = torch.zeros((count, self._env.action_size), device=self._env.device)
            try:
                control = self._control(actions, *(c.start.expand(count, -1) for c in self.carried))
            except Exception as error:
                text = (str(error).splitlines() or [""])[0]
                raise self._control_error(count, f"{type(error).__name__}: {text}") from error
            if control.shape != (count, self._env.model.nu):
                raise self._control_error(count, f"it returns shape {tuple(control.shape)}")

    def _control_error(self, count: int, why: str) -> ExportError:
        return ExportError(
            f"not written: {type(self._env).__qualname__}.control fails for {count} rows of actions ({why}): compute "
            "it from `action`, `self.state.action` and `self.memory` alone, whatever their number of rows"
        )


@torch.no_grad()
def _depends_on_state(env: Env[Any]) -> bool:
    """Whether the same action gives different controls in different states, as with a feedback law."""
    generator = torch.Generator().manual_seed(0)

    def varied(part: Tensor) -> Tensor:
        return part + NOISE * torch.randn(part.shape, generator=generator).to(part)

    state = env.state
    others = state._replace(
        physics=StepState(*map(varied, state.physics)), age=state.age + torch.arange(env.nworld, device=env.device)
    )
    return _controls_differ(env, others)


@torch.no_grad()
def _depends_on_previous(env: Env[Any]) -> bool:
    """Whether the same action gives different controls after different actions, as with a limited rate."""
    spread = torch.linspace(-0.9, 0.9, env.nworld, device=env.device)
    return _controls_differ(env, env.state._replace(action=spread[:, None].repeat(1, env.action_size)))


@torch.no_grad()
def _read_by_control(env: Env[Any]) -> set[str]:
    """Memories whose values change the controls for the same action."""
    spread = torch.linspace(-0.9, 0.9, env.nworld, device=env.device)[:, None]
    memory = env.state.memory
    return {
        name
        for name, values in memory.items()
        if _controls_differ(env, env.state._replace(memory={**memory, name: values + spread}))
    }


def _quoted(names: Iterable[str]) -> str:
    return " and ".join(repr(name) for name in names)


def _controls_differ(env: Env[Any], state: EnvState) -> bool:
    """Whether worlds in these states have different controls for the same action."""
    action = torch.linspace(-0.9, 0.9, env.action_size, device=env.device).expand(env.nworld, -1)
    with env.in_state(state):
        control = env.control(action)
    return not bool((control == control[:1]).all())


@torch.no_grad()
def to_torchscript(policy: PolicyToControl, *inputs: Tensor) -> tuple[bytes, Runner]:
    """TorchScript of a policy, and a function that runs it as another program would."""
    buffer = io.BytesIO()
    with _quiet():
        torch.jit.save(torch.jit.trace(policy, tuple(part[:2] for part in inputs)), buffer)
        loaded = torch.jit.load(io.BytesIO(buffer.getvalue()))

    def run(*inputs: Tensor) -> list[Tensor]:
        with torch.no_grad():
            return list(loaded(*inputs))

    return buffer.getvalue(), run


@torch.no_grad()
def to_onnx(policy: PolicyToControl, *inputs: Tensor) -> tuple[bytes, Runner]:
    """ONNX of a policy, and a function that runs it with onnxruntime."""
    import onnxruntime

    batch = torch.export.Dim("batch")
    with _quiet():
        program = torch.onnx.export(
            policy,
            tuple(part[:2] for part in inputs),
            dynamo=True,
            verbose=False,
            input_names=policy.inputs,
            output_names=policy.outputs,
            # All inputs but the first are one parameter, `*carried`.
            dynamic_shapes=({0: batch}, *([tuple({0: batch} for _ in inputs[1:])] if inputs[1:] else [])),
        )
    assert program is not None
    payload: bytes = program.model_proto.SerializeToString()
    session = onnxruntime.InferenceSession(payload, providers=["CPUExecutionProvider"])

    def run(*inputs: Tensor) -> list[Tensor]:
        given = {name: part.numpy() for name, part in zip(policy.inputs, inputs, strict=True)}
        return [torch.as_tensor(part) for part in session.run(None, given)]

    return payload, run


@contextmanager
def _quiet() -> Iterator[None]:
    """Without torch's warnings that TorchScript is no longer developed, and about optional packages."""
    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", (DeprecationWarning, FutureWarning))
            warnings.filterwarnings("ignore", "# The axis name: batch will not be used")
            yield
    finally:
        exporter.setLevel(level)
