"""The files that a policy can be written as. Imports no torch: the command line reads the table."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from msk_ray.registry import resolve


@dataclass(frozen=True)
class Format:
    """One of them."""

    suffix: str
    """That its files' names must have."""
    help: str
    """What its option says in `--help`."""
    function: str
    """Import path of `function(policy, *inputs)`, which returns the file's bytes and a `Runner` of them."""
    packages: Mapping[str, str] = field(default_factory=dict)
    """Modules that it needs → what to install."""

    @property
    def write(self) -> Callable[..., tuple[bytes, Any]]:
        """The function."""
        write: Callable[..., tuple[bytes, Any]] = resolve(self.function, self.suffix)
        return write


FORMATS = {
    "onnx": Format(
        ".onnx",
        "an .onnx file; needs msk-ray[export]",
        "msk_ray.export.network:to_onnx",
        dict.fromkeys(("onnx", "onnxscript", "onnxruntime"), "msk-ray[export]"),
    ),
    "torchscript": Format(".pt", "a .pt file", "msk_ray.export.network:to_torchscript"),
}
"""Each by its option, `--NAME FILE`."""
