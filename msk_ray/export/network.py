"""An exported policy: from raw observations to actions and controls, in one network.

Axes: N observations, O observation, A action, U controls.
"""

import io
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor, nn

from msk_ray.envs import Env
from msk_ray.envs.records import EnvState
from msk_ray.errors import ConfigError, ExportError
from msk_ray.step import StepState

TOLERANCE = 1e-5
"""Largest accepted difference from the checkpoint's policy, in actions and in controls; controls are divided by their
largest magnitude if that is above 1."""
CHECKED = 1000
"""Observations on which an exported policy is compared with the checkpoint's."""
WORLDS = 8
"""Worlds whose initial states give the observations."""
_NOISE = 0.1
_PACKAGES = ("onnx", "onnxscript", "onnxruntime")

Runner = Callable[..., list[Tensor]]
"""Runs an exported policy on its inputs."""


class PolicyToControl(nn.Module):
    """Raw observations (N, O) to actions (N, A) in [-1, 1] and, unless they depend on the state, controls (N, U).

    If controls depend on the previous action, that is a second input (N, A), 0 in the first step of an episode. The
    normalisation of the observation and the squashing of the action are inside.

    Raises:
        ExportError: the environment's `control` only works for one action per world.
    """

    def __init__(self, network: nn.Module, env: Env[Any]) -> None:
        super().__init__()
        if env.nworld < 2:
            raise ValueError("several worlds are needed to compare their controls")
        self.network = network
        self._env = env
        self.gives_control = not _depends_on_state(env)
        self.takes_previous = self.gives_control and _depends_on_previous(env)
        if self.gives_control:
            self._try_control()

    @property
    def inputs(self) -> list[str]:
        """Names of its inputs."""
        return ["obs", "previous_action"] if self.takes_previous else ["obs"]

    @property
    def outputs(self) -> list[str]:
        """Names of its outputs."""
        return ["action", "ctrl"] if self.gives_control else ["action"]

    def forward(self, obs: Tensor, previous_action: Tensor | None = None) -> tuple[Tensor, ...]:
        action = self.network(obs)
        return (action, self._control(action, previous_action)) if self.gives_control else (action,)

    def examples(self, obs: Tensor, seed: int) -> tuple[Tensor, ...]:
        """Its inputs for some observations, with random previous actions."""
        if not self.takes_previous:
            return (obs,)
        generator = torch.Generator().manual_seed(seed)
        return obs, 2.0 * torch.rand((len(obs), self._env.action_size), generator=generator) - 1.0

    def _control(self, action: Tensor, previous: Tensor | None) -> Tensor:
        if previous is None:
            return self._env.control(action)
        with _state(self._env, self._env.state._replace(action=previous)):
            return self._env.control(action)

    def _try_control(self) -> None:
        """Try `control` on one action, and on more actions than there are worlds."""
        for count in (1, self._env.nworld + 1):
            actions = torch.zeros((count, self._env.action_size), device=self._env.device)
            try:
                control = self._control(actions, actions if self.takes_previous else None)
            except Exception as error:
                text = (str(error).splitlines() or [""])[0]
                raise self._control_error(count, f"{type(error).__name__}: {text}") from error
            if control.shape != (count, self._env.model.nu):
                raise self._control_error(count, f"it returns shape {tuple(control.shape)}")

    def _control_error(self, count: int, why: str) -> ExportError:
        return ExportError(
            f"not written: {type(self._env).__qualname__}.control fails for {count} rows of actions ({why}): compute "
            "it from `action` and `self.state.action` alone, whatever their number of rows"
        )


@contextmanager
def _state(env: Env[Any], state: EnvState) -> Iterator[None]:
    """The environment in another state, inside the block."""
    before, env.state = env.state, state
    try:
        yield
    finally:
        env.state = before


@torch.no_grad()
def _depends_on_state(env: Env[Any]) -> bool:
    """Whether the same action gives different controls in different states, as with a feedback law."""
    generator = torch.Generator().manual_seed(0)

    def varied(part: Tensor) -> Tensor:
        return part + _NOISE * torch.randn(part.shape, generator=generator).to(part)

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


def _controls_differ(env: Env[Any], state: EnvState) -> bool:
    """Whether worlds in these states have different controls for the same action."""
    action = torch.linspace(-0.9, 0.9, env.action_size, device=env.device).expand(env.nworld, -1)
    with _state(env, state):
        control = env.control(action)
    return not bool((control == control[:1]).all())


@torch.no_grad()
def observations(env: Env[Any], seed: int) -> Tensor:
    """`CHECKED` observations (N, O) of initial states, with noise so that no two are equal."""
    generator = torch.Generator().manual_seed(seed)
    rounds = -(-CHECKED // env.nworld)
    drawn = []
    for _ in range(rounds):
        env.state = env.reset_state()
        drawn.append(env.observation().cpu())
    obs = torch.cat(drawn)[:CHECKED]
    return obs + _NOISE * torch.randn(obs.shape, generator=generator)


def check_packages() -> None:
    """Raise ConfigError if a package that ONNX needs is not installed."""
    missing = [name for name in _PACKAGES if find_spec(name) is None]
    if missing:
        raise ConfigError(f"--onnx needs {', '.join(missing)}: pip install 'msk-ray[export]'")


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
            dynamic_shapes=tuple({0: batch} for _ in inputs),
        )
    assert program is not None
    payload: bytes = program.model_proto.SerializeToString()
    session = onnxruntime.InferenceSession(payload, providers=["CPUExecutionProvider"])

    def run(*inputs: Tensor) -> list[Tensor]:
        given = {name: part.numpy() for name, part in zip(policy.inputs, inputs, strict=True)}
        return [torch.as_tensor(part) for part in session.run(None, given)]

    return payload, run


@torch.no_grad()
def largest_difference(policy: PolicyToControl, run: Runner, *inputs: Tensor) -> float:
    """Largest difference between the outputs of an exported policy and the checkpoint's, one by one and in a batch.

    Raises:
        ExportError: it is above `TOLERANCE`, or not a number.
    """
    wanted = policy(*inputs)
    rows = zip(*(part[:WORLDS].split(1) for part in inputs), strict=True)
    single = [torch.cat(parts) for parts in zip(*(run(*row) for row in rows), strict=True)]
    outputs = [(name, ours, theirs) for name, ours, theirs in zip(policy.outputs, wanted, run(*inputs), strict=True)]
    outputs += [
        (name, ours[:WORLDS], theirs) for name, ours, theirs in zip(policy.outputs, wanted, single, strict=True)
    ]
    worst = 0.0
    for name, ours, theirs in outputs:
        difference = float((ours - theirs).abs().max() / ours.abs().max().clamp_min(1.0))
        if not difference <= TOLERANCE:
            raise ExportError(
                f"not written: its {name} differs from the checkpoint's by {difference:.1e} on one of {len(inputs[0])} "
                f"observations, more than {TOLERANCE:.0e}"
            )
        worst = max(worst, difference)
    return worst


@contextmanager
def _quiet() -> Iterator[None]:
    """Without torch's warnings that TorchScript is no longer developed, and about optional packages."""
    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", (DeprecationWarning, FutureWarning))
            yield
    finally:
        exporter.setLevel(level)
