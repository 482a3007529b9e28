"""Adam with its state at fixed addresses, for recorded graphs."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

_EPSILON = 1e-8
_PIECE = 2048
"""Elements of a parameter that are stepped together on a GPU. Torch's fused kernel has a block of threads for each
tensor, or each 65536 elements of one, so that for three layers nearly all of the GPU would be idle."""
_NORM_EPSILON = 1e-6


@torch.no_grad()
def clip_gradients(parameters: Iterable[nn.Parameter], limit: float) -> Tensor:
    """Clip the joint norm of the gradients in place, and return the norm before; infinity for no bound."""
    used = [parameter for parameter in parameters if parameter.grad is not None]
    clipped, norm = clip([parameter.grad for parameter in used if parameter.grad is not None], limit)
    for parameter, part in zip(used, clipped, strict=True):
        parameter.grad = part
    return norm


@torch.no_grad()
def clip(gradients: Sequence[Tensor], limit: float) -> tuple[list[Tensor], Tensor]:
    """Gradients clipped to joint norm `limit`, as views of one tensor, and their norm before.

    One tensor needs few kernels. torch's clip_grad_norm_ uses many, and rounds differently.
    """
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    norm = clip_rows(flat, limit)
    return views_of(flat, gradients), norm


@torch.no_grad()
def clip_rows(gradients: Tensor, limit: float) -> Tensor:
    """Clip the norm of each row of a tensor (..., N) in place, and return the norms before; infinity for no bound."""
    norms = torch.linalg.vector_norm(gradients, dim=-1)
    if limit < float("inf"):
        gradients.mul_((limit / (norms + _NORM_EPSILON)).clamp_max(1.0).unsqueeze(-1))
    return norms


def views_of(flat: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """Consecutive parts of one tensor (N,), in these shapes."""
    parts = flat.split([tensor.numel() for tensor in like])
    return [part.view_as(tensor) for part, tensor in zip(parts, like, strict=True)]


class RateAdam:
    """Adam (Kingma and Ba 2015, arXiv:1412.6980), or AdamW, with a learning rate that can change during training.

    One kernel steps all parameters. Step count and rate live on their device, so that a recorded graph follows them.
    It does what `torch.optim.AdamW(fused=True)` does, without that class: its first instance imports torch's compiler,
    which takes seconds.

    Args:
        parameters: what to optimise, all on one device.
        rate: initial learning rate.
        betas: moment decays.
        weight_decay: decoupled weight decay (Loshchilov and Hutter 2019, arXiv:1711.05101); 0 for none.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter], rate: float, betas: tuple[float, float], weight_decay: float = 0.0
    ) -> None:
        self._parameters = list(parameters)
        self._betas = betas
        self._weight_decay = weight_decay
        device = self._parameters[0].device
        self._piece = None if device.type == "cpu" else _PIECE
        self._rate = torch.tensor(rate, device=device)
        self._count = torch.zeros((), device=device)
        self._means, self._squares = (
            [torch.zeros_like(parameter, requires_grad=False) for parameter in self._parameters] for _ in range(2)
        )

    def set_rate(self, rate: float) -> None:
        """Use this learning rate from the next step on."""
        self._rate.fill_(rate)

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self, skip: Tensor | None = None) -> None:
        """Take a step along the current gradients; parameters without a gradient stay unchanged.

        Args:
            skip: a bool scalar; True leaves parameters and moments unchanged. The host does not wait for it.
        """
        self.step_along([parameter.grad for parameter in self._parameters], skip)

    @torch.no_grad()
    def step_along(self, gradients: Sequence[Tensor | None], skip: Tensor | None = None) -> None:
        """Take a step along these gradients, one per parameter."""
        used = [k for k, gradient in enumerate(gradients) if gradient is not None]
        skipped = None if skip is None else skip.float()
        self._count += 1 if skipped is None else 1 - skipped
        stepped, means, squares = (
            self._pieces(values[k] for k in used) for values in (self._parameters, self._means, self._squares)
        )
        torch._fused_adamw_(
            stepped,
            self._pieces(gradient.contiguous() for gradient in gradients if gradient is not None),
            means,
            squares,
            [],
            [self._count] * len(stepped),
            lr=self._rate,
            beta1=self._betas[0],
            beta2=self._betas[1],
            weight_decay=self._weight_decay,
            eps=_EPSILON,
            amsgrad=False,
            maximize=False,
            grad_scale=None,
            found_inf=skipped,
        )

    def _pieces(self, tensors: Iterable[Tensor]) -> list[Tensor]:
        """The tensors, or views of their parts."""
        if self._piece is None:
            return list(tensors)
        return [part for tensor in tensors for part in tensor.view(-1).split(self._piece)]

    def state_dict(self) -> dict[str, Any]:
        """Step count and moments by parameter index, as torch's optimisers write them."""
        moments = enumerate(zip(self._means, self._squares, strict=True))
        return {"state": {k: {"step": self._count, "exp_avg": mean, "exp_avg_sq": sq} for k, (mean, sq) in moments}}

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`, also from one of torch's Adam or of another device."""
        unused = {"step": 0.0, "exp_avg": 0.0, "exp_avg_sq": 0.0}  # torch's Adam has no entries before its first step
        for k, (mean, square) in enumerate(zip(self._means, self._squares, strict=True)):
            loaded = state["state"].get(k, unused)
            mean.copy_(torch.as_tensor(loaded["exp_avg"]))
            square.copy_(torch.as_tensor(loaded["exp_avg_sq"]))
            if k == 0:
                self._count.copy_(torch.as_tensor(loaded["step"]))
