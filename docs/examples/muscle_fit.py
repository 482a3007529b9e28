"""Fit a muscle's path and fibres to measured torques over joint angle and activation, by Gauss-Newton.

    python docs/examples/muscle_fit.py muscle_fit.png

Every measurement is one world: the knee is held at an angle, the muscle at an activation, and a single step from rest
shows the torque. The derivative of all torques by the insertion, the radius that the tendon wraps around, and the
muscle's operating range, force-length curve and passive force is one pullback. The peak force is known, say from the
muscle's cross-section.
"""

import argparse

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import torch
from torch import Tensor

from msk_ray.step import Simulation

MODEL = """
<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <site name="origin" pos="0.05 0 0.25"/><site name="side" pos="0.1 0 0"/>
  <geom name="condyle" type="cylinder" size="0.03 0.03" euler="90 0 0" contype="0" conaffinity="0"/>
  <body><joint name="knee" axis="0 1 0" armature="1"/><site name="insertion" pos="0.045 0 -0.08"/>
    <geom type="capsule" fromto="0 0 -0.05 0 0 -0.4" size="0.04" mass="3" contype="0" conaffinity="0"/></body>
  </worldbody><tendon><spatial name="quadriceps">
    <site site="origin"/><geom geom="condyle" sidesite="side"/><site site="insertion"/></spatial></tendon>
  <actuator><muscle tendon="quadriceps" force="3000" range="0.6 1.5" lengthrange="0.3 0.42" lmin="0.5" lmax="1.7"
    fpmax="1.3"/></actuator></mujoco>"""
NAMES = ("insertion x", "insertion z", "radius", "range low", "range high", "lmin", "lmax", "fpmax")
TRUTH = torch.tensor([1.2, 0.85, 1.25, 0.9, 1.06, 0.94, 1.05, 1.2]).log()
"""What the measured muscle has of the model's values, as a logarithm."""
ACTIVATIONS = (0.0, 0.35, 0.7, 1.0)
NOISE = 1.0
"""Standard deviation of a measured torque [N m]."""


def parameters(model: mujoco.MjModel, theta: Tensor) -> dict[str, Tensor]:
    """Fields of the model for θ of shape (W, 8), a row per world."""
    own = lambda name: torch.as_tensor(getattr(model, name), dtype=torch.float32).expand(len(theta), -1, -1)  # noqa: E731
    share = theta.exp()
    insertion, condyle = model.site("insertion").id, model.geom("condyle").id
    site, size, prm = (own(name).clone() for name in ("site_pos", "geom_size", "actuator_gainprm"))
    site[:, insertion, 0] = own("site_pos")[:, insertion, 0] * share[:, 0]
    site[:, insertion, 2] = own("site_pos")[:, insertion, 2] * share[:, 1]
    size[:, condyle, 0] = own("geom_size")[:, condyle, 0] * share[:, 2]
    for place, column in ((3, 0), (4, 1), (5, 4), (6, 5), (7, 7)):
        prm[:, 0, column] = own("actuator_gainprm")[:, 0, column] * share[:, place]
    # A muscle has its parameters twice: for its active force and for its passive one.
    return {"site_pos": site, "geom_size": size, "actuator_gainprm": prm, "actuator_biasprm": prm}


class Torques:
    """Torques of the muscle at all angles and activations, and their derivatives."""

    def __init__(self, model: mujoco.MjModel, angles: Tensor) -> None:
        grid = torch.cartesian_prod(torch.tensor(ACTIVATIONS), angles)
        self._act, self._angle = grid[:, :1].contiguous(), grid[:, 1:].contiguous()
        self._sim = Simulation(model, len(grid), 1)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        self._inertia = float(data.M[0]) / model.opt.timestep

    def __call__(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Torques (W,) and their derivative by θ (W, 8)."""
        rows = theta.expand(len(self._act), -1).clone().requires_grad_()
        still = torch.zeros_like(self._angle)
        values = parameters(self._sim.model, rows)
        end = self._sim.step(self._act, self._angle, still, self._act, parameters=values)
        torque = self._inertia * end.qvel[:, 0]
        (slopes,) = torch.autograd.grad(torque.sum(), rows)
        return torque.detach(), slopes


def fit(torques: Torques, measured: Tensor, iterations: int) -> Tensor:
    """θ of the least squares of torques, by Levenberg-Marquardt from the model's own values."""
    theta, damping = torch.zeros(len(NAMES)), 1e-3
    found, slopes = torques(theta)
    for iteration in range(iterations):
        residual = (found - measured).double()
        normal = slopes.double().T @ slopes.double()
        change = torch.linalg.solve(normal + damping * torch.diag(normal.diag()), slopes.double().T @ residual)
        tried = (theta - change.float()).clamp(-0.5, 0.5)
        tried_found, tried_slopes = torques(tried)
        if (tried_found - measured).square().mean() < (found - measured).square().mean():
            theta, found, slopes, damping = tried, tried_found, tried_slopes, 0.1 * damping
        else:
            damping *= 10.0
        error = float((found - measured).square().mean().sqrt())
        print(f"iteration {iteration + 1}: root mean square of the residual {error:.2f} N m")
    return theta


def moment_arms(model: mujoco.MjModel, theta: Tensor, angles: Tensor) -> np.ndarray:
    """Moment arm of the muscle at each angle [m], by C MuJoCo."""
    fitted = mujoco.MjModel.from_xml_string(MODEL)
    for name, value in parameters(model, theta[None]).items():
        getattr(fitted, name)[:] = value[0].numpy()
    data, arms = mujoco.MjData(fitted), []
    for angle in angles.tolist():
        data.qpos[:] = angle
        mujoco.mj_fwdPosition(fitted, data)
        arms.append(-float(data.ten_J.flat[0]))
    return np.array(arms)


def draw(
    model: mujoco.MjModel, angles: Tensor, curves: dict[str, tuple[Tensor, Tensor]], measured: Tensor
) -> plt.Figure:
    """Torques, moment arms and parameters; `curves` has (θ, torques) by label."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(15, 4))
    degrees = torch.rad2deg(angles).numpy()
    for k, activation in enumerate(ACTIVATIONS):
        color = plt.cm.viridis(0.85 * k / (len(ACTIVATIONS) - 1))
        part = slice(k * len(angles), (k + 1) * len(angles))
        left.plot(degrees, measured[part].numpy(), "o", color=color, markersize=3, label=f"activation {activation}")
        for (_, torque), style in zip(curves.values(), ("--", "-"), strict=True):
            left.plot(degrees, torque[part].numpy(), style, color=color)
    left.set(xlabel="knee [degrees]", ylabel="torque [N m]", title="measured (dots), model (dashed), fitted")
    left.legend(fontsize=7)
    for label, (theta, _) in curves.items():
        middle.plot(degrees, 1e3 * moment_arms(model, theta, angles), label=label)
        right.plot(theta.exp().numpy(), "o", fillstyle="none", label=label)
    middle.plot(degrees, 1e3 * moment_arms(model, TRUTH, angles), "k:", label="truth")
    middle.set(xlabel="knee [degrees]", ylabel="moment arm [mm]", title="moment arm, which was not measured")
    right.plot(TRUTH.exp().numpy(), "k_", markersize=14, label="truth")
    right.set_xticks(range(len(NAMES)), NAMES, rotation=45, fontsize=8)
    right.set(ylabel="of the model's own", title="parameters")
    for panel in (middle, right):
        panel.legend()
    return figure


def main() -> None:
    """Measure, fit and draw."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("picture", nargs="?", default="muscle_fit.png")
    p.add_argument("--angles", type=int, default=40)
    p.add_argument("--iterations", type=int, default=12)
    args = p.parse_args()
    torch.manual_seed(0)
    model = mujoco.MjModel.from_xml_string(MODEL)
    angles = torch.deg2rad(torch.linspace(0.0, 110.0, args.angles))
    torques = Torques(model, angles)
    clean, _ = torques(TRUTH)
    measured = clean + NOISE * torch.randn_like(clean)
    theta = fit(torques, measured, args.iterations)
    print(", ".join(f"{name} {100 * float(e):+.1f} %" for name, e in zip(NAMES, theta - TRUTH, strict=True)))
    own = torch.zeros(len(NAMES))
    curves = {"model": (own, torques(own)[0]), "fitted": (theta, torques(theta)[0])}
    draw(model, angles, curves, measured).savefig(args.picture, dpi=110, bbox_inches="tight")
    print(f"drawn in {args.picture}")


if __name__ == "__main__":
    main()
