"""An environment as a user writes one, and what users get wrong in it."""

import sys
from pathlib import Path
from typing import Any, NamedTuple

SOUND = '''\
import random

import numpy as np
import torch

from msk_ray import Memory, MjcfEnv, Reward, StepState


class WalkerReward(Reward):
    forward: float = 1.0


class Walker(MjcfEnv):
    class Settings(MjcfEnv.Settings):
        reward: WalkerReward = WalkerReward()

    mjcf = """<mujoco><option timestep=".01"/><worldbody><body name="rod"><joint name="turn" axis="0 1 0" damping=".1"/>
      <geom size=".05" fromto="0 0 0 0 0 -.5" type="capsule"/></body></worldbody>
      <actuator><motor joint="turn" ctrlrange="-1 1"/></actuator></mujoco>"""
    reward_names = ("forward", "effort")

    def prepare(self):
        self.scale = torch.ones(1, device=self.device)

    def observe(self, state, action):
        return torch.cat((state.qpos, self.scale * state.qvel), -1)

    def reward_terms(self, state, action, obs):
        forward = self.config.reward.forward * state.qvel[:, 0]
        effort = -action.square().mean(-1)
        return torch.stack((forward, effort), -1)

    def fell(self, state):
        return state.qpos[:, 0] > 3.0

    def outcome_terms(self, state):
        return {"speed": state.qvel[:, 0]}
'''
_FELL = "return state.qpos[:, 0] > 3.0"
_OBSERVE = "return torch.cat((state.qpos, self.scale * state.qvel), -1)"
_FORWARD = "forward = self.config.reward.forward * state.qvel[:, 0]"
_TERMS = "return torch.stack((forward, effort), -1)"
_NAMES = 'reward_names = ("forward", "effort")'
_METHOD = "    def fell("
_MEMORY = f"""    def memories(self):
        return {{"pace": Memory(1)}}

    def remember(self, state, action):
        return {{"pace": state.qvel}}

{_METHOD}"""


class Mistake(NamedTuple):
    """One change of the sound environment, and the message about it."""

    sound: str
    """What stands there."""
    wrong: str
    """What a user wrote instead."""
    message: str
    """Pattern of the message."""


MISTAKES = {
    "reward in float64": Mistake(
        _TERMS,
        f"{_TERMS}.double()",
        r"reward_terms of Walker returns torch\.float64, not torch\.float32: write \.float",
    ),
    "reward of integers": Mistake(_TERMS, f"{_TERMS}.long()", r"reward_terms of Walker returns torch\.int64, not"),
    "reward not stacked": Mistake(
        _TERMS, "return forward, effort", r"reward_terms of Walker returns a tuple, not a tensor: .*torch\.stack\(terms"
    ),
    "reward stacked the other way": Mistake(
        _TERMS, "return torch.stack((forward, effort))", r"reward_terms of Walker has shape \(2, 4\), .* dim=-1"
    ),
    "reward without return": Mistake(
        _TERMS, _TERMS.replace("return", "terms ="), "reward_terms of Walker returns nothing: end it with `return`"
    ),
    "one name in parentheses": Mistake(
        _NAMES, 'reward_names = ("forward")', "Walker has reward_names 'forward': write"
    ),
    "no names": Mistake(_NAMES, "", r"Walker has no reward_names: write a tuple of different names"),
    "one name twice": Mistake(_NAMES, 'reward_names = ("effort", "effort")', "a tuple of different names"),
    "fell of floats": Mistake(
        _FELL, "return (state.qpos[:, 0] > 3.0).float()", r"fell of Walker returns torch\.float32, .* a comparison"
    ),
    "fell of a column": Mistake(_FELL, "return state.qpos > 3.0", r"fell of Walker has shape \(4, 1\), not \(4,\)"),
    "fell of Python": Mistake(_FELL, "return False", "fell of Walker returns a bool, not a tensor: .* a comparison"),
    "exception in fell": Mistake(
        _FELL, "return 1 / 0", r"fell of Walker: ZeroDivisionError: division by zero \(walker\.py:\d+\)$"
    ),
    "exception in memories": Mistake(
        _METHOD,
        f"    def memories(self):\n        return {{'pace': Memory(1 // 0)}}\n\n{_METHOD}",
        "memories of Walker: ZeroDivisionError",
    ),
    "observation in numpy": Mistake(
        _OBSERVE, "return state.qpos.numpy(force=True)", "observe of Walker returns a numpy array, .* with torch"
    ),
    "observation through numpy": Mistake(
        _OBSERVE,
        "return torch.tensor(np.sin(state.qpos.numpy()))",
        r"observe of Walker: .* \(walker\.py:\d+\); compute it w",
    ),
    "observation of another width": Mistake(
        _OBSERVE,
        "return torch.cat((state.qpos, state.qvel), -1)[:, : 1 + int(self.state.age.max() > 0)]",
        "observe of Walker has 2 entries, but 1 before: the number of entries must stay the same",
    ),
    "observation of one number": Mistake(
        _OBSERVE, "return state.qpos[:, 0]", r"observe of Walker has shape \(4,\), not"
    ),
    "obs_size by hand": Mistake(
        _NAMES,
        f"{_NAMES}\n    obs_size = 5",
        "observe of Walker has 2 entries, but its obs_size is 5: leave obs_size out",
    ),
    "constant of numpy": Mistake(
        _OBSERVE,
        "return state.qpos @ torch.tensor(np.eye(1))",
        r"observe of Walker: .*; make constants with dtype=torch",
    ),
    "nothing prepared": Mistake(
        _OBSERVE,
        "return self.target - state.qpos",
        r"observe of Walker: AttributeError: .*; set self\.target in `prepare`",
    ),
    "state written in observe": Mistake(
        _OBSERVE,
        f"state.qpos[:, 0] += 1.0\n        {_OBSERVE}",
        r"observe of Walker changes state\.qpos in place: write to a copy, such as state\.qpos\.clone\(\)",
    ),
    "action written in reward_terms": Mistake(
        _TERMS, f"action.clamp_(-0.5, 0.5)\n        {_TERMS}", "reward_terms of Walker changes action in place: .* copy"
    ),
    "observation written in reward_terms": Mistake(
        _TERMS, f"obs *= 2.0\n        {_TERMS}", "reward_terms of Walker changes obs in place: write to a copy"
    ),
    "no reward section": Mistake(
        "    class Settings(MjcfEnv.Settings):\n        reward: WalkerReward = WalkerReward()\n",
        "",
        "reward_terms of Walker: .*'forward'.*; write a class derived from Reward .*`reward: MyReward = MyReward",
    ),
    "weight not declared": Mistake(
        _FORWARD,
        _FORWARD.replace("reward.forward", "reward.foward"),
        "reward_terms of Walker: .*'foward'.*; declare the",
    ),
    "setting not declared": Mistake(
        _FELL,
        "return state.qpos[:, 0] > self.config.limit",
        "fell of Walker: .*'limit'.*; declare the field with its def",
    ),
    "noise of torch": Mistake(
        _OBSERVE,
        "return state.qpos + 0.1 * torch.randn_like(state.qpos)",
        r"observe of Walker draws from torch's global generator, .*: draw with self\.uniform\(...\) or self\.normal\(",
    ),
    "noise of numpy": Mistake(
        _FORWARD, f"{_FORWARD} * float(np.random.rand())", "reward_terms of Walker draws from numpy's global generator"
    ),
    "noise of Python": Mistake(
        _FELL, f"{_FELL} + random.random()", "fell of Walker draws from Python's global generator"
    ),
    "drawn constant": Mistake(
        "torch.ones(1, ", "torch.rand(1, ", "prepare of Walker draws from torch's global generator"
    ),
    "drawn start": Mistake(
        "    def fell(",
        "    def draw_physics(self, count):\n        zeros = torch.zeros(count, 1)\n"
        "        return StepState(torch.randn(count, 1), zeros, zeros[:, :0])\n\n    def fell(",
        "draw_physics of Walker draws from torch's global generator",
    ),
    "start in a tuple": Mistake(
        "    def fell(",
        "    def draw_physics(self, count):\n        return tuple(torch.zeros(3, count, 1))\n\n    def fell(",
        r"draw_physics of Walker returns a tuple: return StepState\(qpos, qvel, act\)",
    ),
    "start without velocities": Mistake(
        "    def fell(",
        "    def draw_physics(self, count):\n        none = torch.zeros(count, 0)\n"
        "        return StepState(torch.zeros(count, 1), none, none)\n\n    def fell(",
        r"qvel from draw_physics of Walker has shape \(4, 0\), not \(4, 1\)",
    ),
    "control of another shape": Mistake(
        "    def fell(",
        "    def control(self, action):\n        return action.repeat(1, 2)\n\n    def fell(",
        r"control of Walker has shape \(4, 2\), not \(4, 1\): return one control for each actuator",
    ),
    "critic's view in float64": Mistake(
        "    def fell(",
        "    def observe_critic(self, state, action):\n        return state.qvel.double()\n\n    def fell(",
        r"observe_critic of Walker returns torch\.float64, not torch\.float32",
    ),
    "critic's view of another width": Mistake(
        "    def fell(",
        "    def observe_critic(self, state, action):\n"
        "        return state.qvel.repeat(1, 1 + int(self.state.age.max() > 0))\n\n"
        "    def fell(",
        "observe_critic of Walker has 2 entries, but 1 before: the number of entries must stay the same",
    ),
    "critic's view written in place": Mistake(
        "    def fell(",
        "    def observe_critic(self, state, action):\n        state.qvel[:] = 0.0\n        return state.qvel\n\n"
        "    def fell(",
        r"observe_critic of Walker changes state\.qvel in place: write to a copy",
    ),
    "outcomes without names": Mistake(
        'return {"speed": state.qvel[:, 0]}',
        "return state.qvel[:, 0]",
        "outcome_terms of Walker returns a Tensor: .* dict",
    ),
    "outcome of truth values": Mistake(
        'return {"speed": state.qvel[:, 0]}',
        'return {"fast": state.qvel[:, 0] > 1.0}',
        r"'fast' in outcome_terms of Walker returns torch\.bool, not torch\.float32: write \.float\(\)",
    ),
    "memory that is a number": Mistake(
        _METHOD, f"{_MEMORY.replace('Memory(1)', '1')}", r"'pace' in memories of Walker is 1: write Memory\(size\)"
    ),
    "memory not remembered": Mistake(
        _METHOD, _MEMORY.split("    def remember")[0] + _METHOD, "remember of Walker gives no 'pace': .* self.memory"
    ),
    "memory not declared": Mistake(
        _METHOD,
        "    def remember" + _MEMORY.split("    def remember")[1],
        "remember of Walker gives 'pace', .* declare",
    ),
    "memory of another size": Mistake(
        _METHOD,
        _MEMORY.replace("Memory(1)", "Memory(2)"),
        r"'pace' from remember of Walker has shape \(4, 1\), not \(4, 2\)",
    ),
    "memory in a list": Mistake(
        _METHOD,
        _MEMORY.replace('{"pace": state.qvel}', "[state.qvel]"),
        "remember of Walker returns a list: return a dict of tensors by name",
    ),
    "memory written in place": Mistake(
        _METHOD,
        _MEMORY.replace('{"pace": state.qvel}', '{"pace": self.memory["pace"].copy_(state.qvel)}'),
        r"remember of Walker changes self\.memory\['pace'\] in place: write to a copy",
    ),
    "start of a memory in float64": Mistake(
        _METHOD,
        f"    def begin_memory(self, state):\n        return {{'pace': state.qvel.double()}}\n\n{_MEMORY}",
        r"'pace' from begin_memory of Walker returns torch\.float64",
    ),
    "exception at the start of a memory": Mistake(
        _METHOD,
        f"    def begin_memory(self, state):\n        return 1 / 0\n\n{_MEMORY}",
        r"begin_memory of Walker: ZeroDivisionError: division by zero \(walker\.py:\d+\)$",
    ),
}


def write(folder: Path, *changes: Mistake | tuple[str, str], **_: Any) -> None:
    """The module `walker` with these changes, to be imported anew."""
    text = SOUND
    for sound, wrong, *_rest in changes:
        assert text.count(sound) == 1, sound
        text = text.replace(sound, wrong)
    (folder / "walker.py").write_text(text)
    sys.modules.pop("walker", None)
