"""Adam, in the form that suits its device."""

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn


class RateAdam:
    """Adam whose learning rate changes during training.

    On CUDA all its parameters are one kernel, and step count and rate live on the device, so that a recorded graph
    follows them.

    Args:
        parameters: what to optimise, all on one device.
        rate: initial learning rate.
        betas: moment decays.
        weight_decay: decoupled weight decay; 0 for none.

    Attributes:
        optimizer: torch's optimiser, Adam or AdamW.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter], rate: float, betas: tuple[float, float], weight_decay: float = 0.0
    ) -> None:
        found = list(parameters)
        self._on_cuda = found[0].device.type == "cuda"
        # A recorded graph reads the rate from memory; a number would be fixed in it.
        self._rate: Tensor | float = torch.tensor(rate, device=found[0].device) if self._on_cuda else rate
        self._own: dict[str, Any] = {"lr": self._rate, "fused": self._on_cuda, "capturable": self._on_cuda}
        self.optimizer: torch.optim.Optimizer = (
            torch.optim.AdamW(found, betas=betas, weight_decay=weight_decay, **self._own)
            if weight_decay > 0.0
            else torch.optim.Adam(found, betas=betas, **self._own)
        )

    def set_rate(self, rate: float) -> None:
        """Use this learning rate from the next step on."""
        for group in self.optimizer.param_groups:
            if isinstance(self._rate, Tensor):
                self._rate.fill_(rate)
            else:
                group["lr"] = rate

    def step(self, skip: Tensor | None = None) -> None:
        """Take a step with the present gradients.

        Args:
            skip: a bool scalar; True leaves parameters and moments as they are. On CUDA the host does not wait for it.
        """
        if self._on_cuda:
            # How torch's GradScaler skips a step.
            self.optimizer.found_inf = None if skip is None else skip.float()  # type: ignore[attr-defined]
            self.optimizer.step()
        elif skip is None or not skip:
            self.optimizer.step()

    def state_dict(self) -> dict[str, Any]:
        """State of torch's optimiser."""
        return self.optimizer.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state, also one written on another device."""
        before = dict(self.optimizer.state)
        self.optimizer.load_state_dict(dict(state))
        for group in self.optimizer.param_groups:
            group.update(self._own)
        for parameter, loaded in self.optimizer.state.items():
            if self._on_cuda:
                loaded["step"] = loaded["step"].to(parameter.device)
            # In the same memory as before, which recorded graphs read and write.
            for name, kept in before.get(parameter, {}).items():
                loaded[name] = kept.copy_(loaded[name])
