"""Poses of two free bodies, moved and turned."""

import mujoco
import numpy as np


def turned(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Quaternion after a rotation by a vector in the world's frame."""
    angle = float(np.linalg.norm(vector))
    turn, out = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, vector / max(angle, 1e-12), angle)
    mujoco.mju_mulQuat(out, turn, quat)
    return out


def displaced(qpos: np.ndarray, size: float) -> list[np.ndarray]:
    """Both signs of each of 12 displacements: (force 1, torque 1, force 2, torque 2) read them off."""
    poses = []
    for address in (0, 7):
        for turn in (False, True):
            for k in range(3):
                for sign in (1, -1):
                    moved = qpos.copy()
                    step = np.zeros(3)
                    step[k] = sign * size
                    if turn:
                        moved[address + 3 : address + 7] = turned(moved[address + 3 : address + 7], step)
                    else:
                        moved[address : address + 3] += step
                    poses.append(moved)
    return poses
