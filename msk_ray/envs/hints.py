"""An exception in a user's environment in one line: where it is, and what to write instead if that is known."""

import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msk_ray.config import Reward
from msk_ray.errors import shortened

if TYPE_CHECKING:
    from msk_ray.envs.base import Env

_PACKAGE = Path(__file__).resolve().parents[1]
_HINTS = {
    "numpy() on Tensor": "compute it with torch: numpy cuts gradients",
    "convert": "return what torch computes, without .numpy() and .item()",
    "same device": "make constants once, in `prepare`, with device=self.device",
    "dtype": "make constants with dtype=torch.float32: an array of numpy becomes float64",
    "inplace": "write to a copy, such as state.qpos.clone()",
    "in-place": "write to a copy, such as state.qpos.clone()",
}
"""What to write instead, by what an exception's message contains."""


def described(error: Exception, env: "Env[Any]") -> str:
    """An exception that a method of the environment has raised."""
    text = shortened(" ".join((str(error).splitlines() or [""])[0].split()), 200)
    frames = traceback.extract_tb(error.__traceback__)
    modules = [sys.modules.get(base.__module__) for base in type(env).__mro__]
    files = {getattr(module, "__file__", None) for module in modules}
    own = [frame for frame in frames if frame.filename in files and _PACKAGE not in Path(frame.filename).parents]
    place, hint = (own or frames)[-1], _hint(error, env)
    at = f"{Path(place.filename).name}:{place.lineno}"
    return f"{type(error).__name__}: {text} ({at}){f'; {hint}' if hint else ''}"


def _hint(error: Exception, env: "Env[Any]") -> str | None:
    text = str(error)
    if isinstance(error, AttributeError):
        settings = type(env.config)
        if type(env.config.reward) is Reward and text.startswith("'Reward' object"):
            return (
                "write a class derived from Reward with every weight and its default, and a field "
                "`reward: MyReward = MyReward()` in Settings"
            )
        if text.startswith((f"{settings.__name__!r} object", f"{type(env.config.reward).__name__!r} object")):
            return "declare the field with its default in that class"
        if error.obj is env:
            return f"set self.{error.name} in `prepare`"
    return next((hint for words, hint in _HINTS.items() if words in text), None)
