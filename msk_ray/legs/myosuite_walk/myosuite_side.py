"""Runs episodes of an unmodified MyoSuite environment for `scoring`, in a Python that has MyoSuite.

That Python has other versions of MuJoCo and gymnasium and lacks this package, so this file imports nothing of it. It is
started with one JSON argument {env, reset, seed, episodes, steps}. On standard output it writes a line of JSON, which
says what it runs, and then a `record` for each reset and each step; on standard input it reads an action before each
step. MyoSuite's own messages go to standard error.
"""

import importlib.metadata
import json
import os
import sys

import numpy as np

TERMS = ("vel_reward", "cyclic_hip", "ref_rot", "joint_angle_rew", "done")
"""Names of the parts of the reward."""


def record(observations: int) -> np.dtype:
    """What follows a reset, in which only `obs` counts, or a step."""
    return np.dtype(
        [
            ("reward", "<f8"),
            ("terms", "<f8", (len(TERMS),)),
            ("forward", "<f8"),
            ("activation", "<f8"),
            ("terminated", "?"),
            ("diverged", "?"),
            ("obs", "<f4", (observations,)),
        ]
    )


def main() -> None:
    """Run the episodes that the argument asks for."""
    asked = json.loads(sys.argv[1])
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # MyoSuite prints
    os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is drawn
    from myosuite.utils import gym

    env = gym.make(asked["env"], seed=asked["seed"], reset_type=asked["reset"])
    inner = env.unwrapped
    observations, actions = env.observation_space.shape[0], env.action_space.shape[0]
    versions = {name: importlib.metadata.version(name) for name in ("myosuite", "mujoco", "gymnasium")}
    hello = {"versions": versions, "observations": observations, "actions": actions, "seconds": float(inner.dt)}
    answers.write(json.dumps(hello).encode() + b"\n")
    answers.flush()
    answer = np.zeros((), record(observations))

    def send() -> None:
        answers.write(answer.tobytes())
        answers.flush()

    for _ in range(asked["episodes"]):
        answer["obs"], _ = env.reset()
        send()
        for _ in range(asked["steps"]):
            action = np.frombuffer(sys.stdin.buffer.read(4 * actions), "<f4")
            answer["obs"], answer["reward"], ended, cut, info = env.step(action)
            terms = info["rwd_dict"]
            answer["terms"] = [inner.rwd_keys_wt[name] * float(terms[name]) for name in TERMS]
            answer["forward"] = info["obs_dict"]["com_vel"][1]
            answer["activation"] = np.mean(np.square(info["obs_dict"]["act"]))
            # MuJoCo resets a state that is not finite and counts a warning.
            answer["diverged"] = any(warning.number for warning in _diverging(inner.mj_data))
            answer["terminated"] = ended
            send()
            if ended or cut or answer["diverged"]:
                break


def _diverging(data):  # type: ignore[no-untyped-def]  # MuJoCo's types are not known here
    import mujoco

    kinds = mujoco.mjtWarning
    return [data.warning[int(kind)] for kind in (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)]


if __name__ == "__main__":
    main()
