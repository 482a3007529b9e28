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
from msk_ray.errors import ConfigError, ExportError

TOLERANCE = 1e-5
"""Largest difference from the checkpoint's policy that is accepted, in actions and in controls divided by their
largest size if that is above 1."""
CHECKED = 1000
"""Observations on which an exported policy is compared with the checkpoint's."""
WORLDS = 8
"""Worlds whose initial states give the observations."""
_NOISE = 0.1
_PACKAGES = ("onnx", "onnxscript", "onnxruntime")

Runner = Callable[[Tensor], list[Tensor]]


class PolicyToControl(nn.Module):
    """Raw observations (N, O) to actions (N, A) in [-1, 1] and, where they do not depend on the state, controls (N, U).

    The normalisation of the observation and the squashing of the action are inside.
    """

    def __init__(self, network: nn.Module, env: Env[Any]) -> None:
        super().__init__()
        self.network = network
        self._control = env.control
        self.gives_control = not _control_depends_on_state(env)

    @property
    def outputs(self) -> list[str]:
        """Names of what it returns."""
        return ["action", "ctrl"] if self.gives_control else ["action"]

    def forward(self, obs: Tensor) -> tuple[Tensor, ...]:
        action = self.network(obs)
        return (action, self._control(action)) if self.gives_control else (action,)


def _control_depends_on_state(env: Env[Any]) -> bool:
    """Whether one action means other controls in other states, as with an assisting force or a feedback law."""
    if env.nworld < 2:
        raise ValueError("several worlds are needed to compare their controls")
    action = torch.linspace(-0.9, 0.9, env.action_size, device=env.device).expand(env.nworld, -1)
    control = env.control(action)
    return not bool((control == control[:1]).all())


@torch.no_grad()
def observations(env: Env[Any], seed: int) -> Tensor:
    """`CHECKED` observations (N, O): those of initial states, with noise so that no two are equal."""
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
def to_torchscript(policy: PolicyToControl, obs: Tensor) -> tuple[bytes, Runner]:
    """TorchScript of a policy, and a function that runs it as another program would."""
    buffer = io.BytesIO()
    with _quiet():
        torch.jit.save(torch.jit.trace(policy, (obs[:2],)), buffer)
        loaded = torch.jit.load(io.BytesIO(buffer.getvalue()))

    def run(obs: Tensor) -> list[Tensor]:
        with torch.no_grad():
            return list(loaded(obs))

    return buffer.getvalue(), run


@torch.no_grad()
def to_onnx(policy: PolicyToControl, obs: Tensor) -> tuple[bytes, Runner]:
    """ONNX of a policy, and a function that runs it with onnxruntime."""
    import onnxruntime

    with _quiet():
        program = torch.onnx.export(
            policy,
            (obs[:2],),
            dynamo=True,
            verbose=False,
            input_names=["obs"],
            output_names=policy.outputs,
            dynamic_shapes=({0: torch.export.Dim("batch")},),
        )
    assert program is not None
    payload: bytes = program.model_proto.SerializeToString()
    session = onnxruntime.InferenceSession(payload, providers=["CPUExecutionProvider"])

    def run(obs: Tensor) -> list[Tensor]:
        return [torch.as_tensor(part) for part in session.run(None, {"obs": obs.numpy()})]

    return payload, run


@torch.no_grad()
def largest_difference(policy: PolicyToControl, run: Runner, obs: Tensor) -> float:
    """Largest difference between what an exported policy computes and the checkpoint's, one by one and in a batch.

    Raises:
        ExportError: it is above `TOLERANCE`, or not a number.
    """
    wanted = policy(obs)
    single = [torch.cat(parts) for parts in zip(*(run(row[None]) for row in obs[:WORLDS]), strict=True)]
    found = [(name, ours, theirs) for name, ours, theirs in zip(policy.outputs, wanted, run(obs), strict=True)]
    found += [(name, ours[:WORLDS], theirs) for name, ours, theirs in zip(policy.outputs, wanted, single, strict=True)]
    worst = 0.0
    for name, ours, theirs in found:
        difference = float((ours - theirs).abs().max() / ours.abs().max().clamp_min(1.0))
        if not difference <= TOLERANCE:
            raise ExportError(
                f"not written: its {name} differs from the checkpoint's by {difference:.1e} on one of {len(obs)} "
                f"observations, more than {TOLERANCE:.0e}"
            )
        worst = max(worst, difference)
    return worst


@contextmanager
def _quiet() -> Iterator[None]:
    """Without torch's remarks on its own parts: that TorchScript is no longer developed, and on packages it can do
    without."""
    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", (DeprecationWarning, FutureWarning))
            yield
    finally:
        exporter.setLevel(level)
