"""How far are the contacts and joint limits of `matched` physics from dflex's own? Policies are scored under both,
and those of the ant under `matched_springs`.

dflex's law (`eval_rigid_contacts_art` and `jcalc_tau` in `dflex/dflex/sim.py` of github.com/NVlabs/DiffRL) is applied
as external forces in C MuJoCo, to the model of `matched` physics without its contacts and limits: k_e·c out of the
floor, k_d·c·v against approach, k_f·v along the floor, at most μ·k_e·c, and k_l per rad beyond a joint's range.

    python lab/benchmarks/dflex_floor.py CHECKPOINT... --steps 500 --episodes 4
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from record import markdown_table, publish

from msk_ray.cli import run
from msk_ray.config import PhysicsConfig
from msk_ray.envs import Env, env_class, make_env
from msk_ray.errors import ConfigError
from msk_ray.simulation import StepState
from msk_ray.training import load_policy

SUBSTEPS = 64
"""Of an env step under dflex's law; dflex takes 16, and 48 for the humanoid."""
LIMIT_STIFFNESS = 1e3
"""k_l [N m/rad]."""


@dataclass(frozen=True)
class Law:
    """Contact of DiffRL's `envs/*.py`."""

    stiffness: float
    damping: float
    """k_d [N s/m²]."""
    friction_damping: float
    friction: float


LAWS = {
    "ant": Law(4e4, 1e4, 3e3, 0.75),
    "hopper": Law(2e4, 1e3, 1e3, 0.9),
    "cheetah": Law(2e4, 1e3, 1e3, 1.0),
    "humanoid": Law(2e4, 5e3, 1e3, 0.75),
}


class Springs:
    """Steps of a model with dflex's contacts and limits."""

    def __init__(self, model: mujoco.MjModel, law: Law) -> None:
        self.law = law
        self.geoms = [g for g in range(model.ngeom) if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE]
        self.limited = [j for j in range(model.njnt) if model.jnt_limited[j]]
        self.low, self.high = model.jnt_range[self.limited].T
        self.qpos, self.dof = model.jnt_qposadr[self.limited], model.jnt_dofadr[self.limited]

    def apply(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Set the external forces of the current state."""
        data.qfrc_applied[:] = 0.0
        angle = data.qpos[self.qpos]
        beyond = np.minimum(angle - self.low, 0.0) + np.maximum(angle - self.high, 0.0)
        data.qfrc_applied[self.dof] -= LIMIT_STIFFNESS * beyond
        jacobian = np.zeros((3, model.nv))
        for geom in self.geoms:
            along = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
            capsule = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE
            for sign in (-1.0, 1.0) if capsule else (0.0,):
                point = data.geom_xpos[geom] + sign * along
                depth = model.geom_size[geom, 0] - point[2]
                if depth <= 0.0:
                    continue
                point[2] = -depth
                mujoco.mj_jac(model, data, jacobian, None, point, int(model.geom_bodyid[geom]))
                data.qfrc_applied += jacobian.T @ self.force(depth, jacobian @ data.qvel)

    def force(self, depth: float, velocity: np.ndarray) -> np.ndarray:
        """Force (3,) on a point this deep in the floor."""
        law, sliding = self.law, velocity * (1.0, 1.0, 0.0)
        speed = float(np.linalg.norm(sliding))
        out = law.stiffness * depth - law.damping * depth * min(velocity[2], 0.0)
        friction = min(law.friction_damping * speed, law.friction * law.stiffness * depth)
        return np.array((0.0, 0.0, out)) - (friction / speed * sliding if speed > 0.0 else 0.0)


Advance = Callable[[mujoco.MjModel, mujoco.MjData], None]


@torch.no_grad()
def episode(
    env: Env[Any], network: torch.nn.Module, model: mujoco.MjModel, advance: Advance, steps: int
) -> list[float]:
    """Score, env steps and mean velocity along x of an episode from a new initial state of `env`, of one world."""
    data = mujoco.MjData(model)
    start = env.draw_physics(1)
    data.qpos[:], data.qvel[:] = start.qpos[0].numpy(), start.qvel[0].numpy()
    action, score, first = torch.zeros(1, env.action_size), 0.0, data.qpos[0]
    for step in range(1, steps + 1):  # noqa: B007
        state = _state(data)
        action = network(env.observe(state, action))
        data.ctrl[:] = action[0].numpy()
        advance(model, data)
        state = _state(data)
        score += float(env.reward_terms(state, action, env.observe(state, action)).sum())
        if env.fell(state).any():
            break
    return [score, float(step), (data.qpos[0] - first) / (step * env.config.control_timestep)]


def _state(data: mujoco.MjData) -> StepState:
    return StepState(*(torch.tensor(part[None], dtype=torch.float32) for part in (data.qpos, data.qvel, data.act)))


def compare(path: Path, steps: int, episodes: int) -> list[list[str]]:
    """One row for each named physics and one for dflex's law: policy, which, score and spread, env steps, velocity."""
    policy = load_policy(path)
    name = policy.config.env.name
    if name not in LAWS:
        raise ConfigError(f"{path}: its environment is {name}; write one of {', '.join(LAWS)}")
    body = env_class(policy.config.env)
    # Scores are under the reference reward, whatever the policy was trained on.
    config = body.reference_settings(policy.config.env)
    physics = PhysicsConfig(variant="matched")
    env = make_env(config, physics, 1, "cpu", 0, differentiable=False)
    network = policy.network(env)
    free = body.build_model(config, physics)
    springs = Springs(free, LAWS[name])
    free.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT)
    free.opt.timestep = config.control_timestep / SUBSTEPS

    def as_dflex(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for _ in range(SUBSTEPS):
            mujoco.mj_step1(model, data)
            springs.apply(model, data)
            mujoco.mj_step2(model, data)

    def as_mujoco(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        mujoco.mj_step(model, data, nstep=env.sim.substeps)

    laws: list[tuple[str, mujoco.MjModel, Advance]] = [("matched", env.model, as_mujoco)]
    if "matched_springs" in config.variants:
        near = body.build_model(config, PhysicsConfig(variant="matched_springs"))
        laws.append(("matched_springs", near, as_mujoco))
    laws.append(("dflex's", free, as_dflex))
    rows: list[list[str]] = []
    for law, model, advance in laws:
        env.generator.manual_seed(1234)
        found = np.array([episode(env, network, model, advance, steps) for _ in range(episodes)])
        score, length, speed = found.mean(0)
        rows.append([path.stem, law, f"{score:.0f} ± {found[:, 0].std():.0f}", f"{length:.0f}", f"{speed:.2f}"])
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", type=Path, metavar="CHECKPOINT")
    parser.add_argument("--steps", type=int, default=500, help="env steps of an episode")
    parser.add_argument("--episodes", type=int, default=4)
    args = parser.parse_args(argv)
    rows = [row for path in args.checkpoints for row in compare(path, args.steps, args.episodes)]
    table = markdown_table(["policy", "contacts and limits", "score", "env steps", "vx, m/s"], rows)
    publish("dflex_floor", "Policies under the contacts and limits of `matched` and of dflex", "cpu", table)
    return 0


if __name__ == "__main__":
    sys.exit(run(main))
