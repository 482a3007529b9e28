"""Fit the critic to its targets, one minibatch at a time."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from msk_ray.networks import Critic


@dataclass
class _Captured:
    """A minibatch step recorded as a CUDA graph, with the buffers it reads and writes."""

    graph: torch.cuda.CUDAGraph
    obs: Tensor
    targets: Tensor
    loss: Tensor


class CriticFit:
    """Adam on the mean squared error, with each network's gradient norm bounded.

    On CUDA the step is recorded once per minibatch size and replayed: launched eagerly, its sixty small operations
    take a millisecond of host time, seven times what the device needs for them.

    Args:
        critic: the networks to fit.
        learning_rate: initial rate; `set_learning_rate` changes it.
        betas: Adam's moment decays.
        grad_norm: bound on each network's gradient norm; None for no bound.
    """

    def __init__(
        self, critic: Critic, learning_rate: float, betas: tuple[float, float], grad_norm: float | None
    ) -> None:
        self._critic = critic
        self._grad_norm = grad_norm
        self._device = next(critic.parameters()).device
        self._on_cuda = self._device.type == "cuda"
        # A recorded graph reads the rate from memory; a number would be fixed in it.
        rate = torch.tensor(learning_rate, device=self._device) if self._on_cuda else learning_rate
        self.optimizer = torch.optim.Adam(
            critic.parameters(), lr=rate, betas=betas, fused=self._on_cuda, capturable=self._on_cuda
        )
        self._captured: dict[int, _Captured] = {}

    def set_learning_rate(self, rate: float) -> None:
        """Use `rate` from the next minibatch on."""
        for group in self.optimizer.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    def load_state_dict(self, state: dict[str, object]) -> None:
        """Continue from an optimiser state. Recorded graphs refer to the old one and are dropped."""
        self.optimizer.load_state_dict(state)
        self._captured.clear()

    def run(self, obs: Tensor, targets: Tensor, passes: int, batches: int, generator: torch.Generator) -> Tensor:
        """Make `passes` passes over rows obs (N, O) and targets (N,) in `batches` minibatches in random order.

        Rows that do not fill a minibatch are left out of a pass. Returns the mean loss of the last pass.
        """
        size = obs.shape[0] // batches
        losses = torch.zeros(batches, device=obs.device)
        for _ in range(passes):
            order = torch.randperm(obs.shape[0], generator=generator, device=obs.device)
            for batch in range(batches):
                picked = order[batch * size : (batch + 1) * size]
                losses[batch] = self._minibatch(obs, targets, picked)
        return losses.mean()

    def _minibatch(self, obs: Tensor, targets: Tensor, picked: Tensor) -> Tensor:
        if not self._on_cuda:
            return self._step(obs[picked], targets[picked])
        size = picked.shape[0]
        if size not in self._captured:
            self._captured[size] = self._capture(obs[picked], targets[picked])
        captured = self._captured[size]
        torch.index_select(obs, 0, picked, out=captured.obs)
        torch.index_select(targets, 0, picked, out=captured.targets)
        captured.graph.replay()
        return captured.loss

    def _step(self, obs: Tensor, targets: Tensor) -> Tensor:
        loss = (self._critic(obs) - targets).square().mean()
        self.optimizer.zero_grad()
        loss.backward()
        if self._grad_norm is not None:
            for member in self._critic.members:
                nn.utils.clip_grad_norm_(member.parameters(), self._grad_norm)
        self.optimizer.step()
        return loss.detach()

    def _capture(self, obs: Tensor, targets: Tensor) -> _Captured:
        """Record a step on these buffers without changing parameters and moments."""
        before = {id(t): t.detach().clone() for t in self._tensors()}
        stream = torch.cuda.Stream(self._device)
        stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(stream):
            for _ in range(3):  # lets libraries choose algorithms and the optimiser create its moments
                self._step(obs, targets)
        torch.cuda.current_stream(self._device).wait_stream(stream)
        with torch.no_grad():
            for tensor in self._tensors():
                # A moment the optimiser has only now created was zero.
                tensor.copy_(before[id(tensor)]) if id(tensor) in before else tensor.zero_()
        self.optimizer.zero_grad()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            loss = self._step(obs, targets)
        return _Captured(graph, obs, targets, loss)

    def _tensors(self) -> list[Tensor]:
        moments = [t for state in self.optimizer.state.values() for t in state.values() if isinstance(t, Tensor)]
        return [*self._critic.parameters(), *moments]
