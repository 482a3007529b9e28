"""Adam whose state stays in the same memory."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

_EPSILON = 1e-8
_PIECE = 2048
"""Elements of a parameter that are stepped together on a GPU. Torch's fused kernel has a block of threads for each
tensor, or each 65536 elements of one, so that for three layers nearly all of the GPU would be idle."""
_NORM_EPSILON = 1e-6


def clip_gradients(parameters: Sequence[nn.Parameter], limit: float) -> Tensor:
    """Bound the joint norm of the gradients, in place, and return it as it was; infinity for no bound."""
    if parameters[0].device.type == "cpu":
        return nn.utils.clip_grad_norm_(parameters, limit)
    return clip_flat(parameters, limit)


@torch.no_grad()
def clip_flat(parameters: Sequence[nn.Parameter], limit: float) -> Tensor:
    """The same with all gradients in one tensor, which takes few kernels; their values differ by rounding."""
    used = [parameter for parameter in parameters if parameter.grad is not None]
    flat = torch.cat([parameter.grad.flatten() for parameter in used if parameter.grad is not None])
    norm = torch.linalg.vector_norm(flat)
    if limit < float("inf"):
        flat.mul_((limit / (norm + _NORM_EPSILON)).clamp_max(1.0))
    for parameter, part in zip(used, flat.split([parameter.numel() for parameter in used]), strict=True):
        parameter.grad = part.view_as(parameter)
    return norm


class RateAdam:
    """Adam (Kingma and Ba 2015, arXiv:1412.6980), or AdamW, whose learning rate changes during training.

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
        """Take a step with the present gradients; parameters without one stay as they are.

        Args:
            skip: a bool scalar; True leaves parameters and moments as they are. The host does not wait for it.
        """
        gradients = {k: p.grad for k, p in enumerate(self._parameters) if p.grad is not None}
        skipped = None if skip is None else skip.float()
        self._count += 1 if skipped is None else 1 - skipped
        stepped, means, squares = (
            self._pieces(values[k] for k in gradients) for values in (self._parameters, self._means, self._squares)
        )
        torch._fused_adamw_(
            stepped,
            self._pieces(gradient.contiguous() for gradient in gradients.values()),
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
        """Step count and moments by the parameters' numbers, as torch's optimisers write them."""
        moments = enumerate(zip(self._means, self._squares, strict=True))
        return {"state": {k: {"step": self._count, "exp_avg": mean, "exp_avg_sq": sq} for k, (mean, sq) in moments}}

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state, also one of torch's Adam, or written on another device."""
        unused = {"step": 0.0, "exp_avg": 0.0, "exp_avg_sq": 0.0}  # torch's have no entry before the first step
        for k, (mean, square) in enumerate(zip(self._means, self._squares, strict=True)):
            loaded = state["state"].get(k, unused)
            mean.copy_(torch.as_tensor(loaded["exp_avg"]))
            square.copy_(torch.as_tensor(loaded["exp_avg_sq"]))
            if k == 0:
                self._count.copy_(torch.as_tensor(loaded["step"]))
