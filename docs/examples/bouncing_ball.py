"""The gradient of a bouncing ball: how its final height depends on the speed it is thrown down with.

python bouncing_ball.py picture.png
"""

import argparse

import matplotlib.pyplot as plt
import mujoco
import torch

import msk_ray

MODEL = """
<mujoco><option timestep=".001" integrator="implicitfast"/>
  <default><geom solref="-2000 -2" solimp="{solimp}"/></default>
  <worldbody><geom type="plane" size="1 1 .1"/>
    <body pos="0 0 1"><joint type="slide" axis="0 0 1"/><geom type="sphere" size=".1" mass="1"/></body></worldbody>
</mujoco>"""
CONTACTS = {
    "the force jumps at touch": "0.9 0.95 0.001",  # MuJoCo's default
    "the force grows from zero": "0 0.95 0.05",
}


def final_height(speed: torch.Tensor, steps: int, solimp: str) -> torch.Tensor:
    """Height [m] after `steps` of 10 ms of balls thrown down from 1 m with speeds (W,) [m/s], one per world."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(solimp=solimp))
    sim = msk_ray.Simulation(model, nworld=len(speed), substeps=10)
    qpos, qvel, act = sim.initial_state()
    qvel = qvel - speed[:, None]
    ctrl = torch.zeros(len(speed), 0)
    for _ in range(steps):
        qpos, qvel, act = sim.step(ctrl, qpos, qvel, act)
    return 1.0 + qpos[:, 0]


def main() -> None:
    """Draw the heights, and the slopes that one backward pass gives."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("picture")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--worlds", type=int, default=121)
    args = parser.parse_args()
    figure, panels = plt.subplots(1, 2, figsize=(9, 4), sharey=True, layout="constrained")
    for axes, (name, solimp) in zip(panels, CONTACTS.items(), strict=True):
        speed = torch.linspace(0.0, 3.0, args.worlds, requires_grad=True)
        height = final_height(speed, args.steps, solimp)
        height.sum().backward()  # each world's height depends on its own speed alone
        x, y, slope = speed.detach(), height.detach(), speed.grad
        wide = (y[-1] - y[0]) / (x[-1] - x[0])
        print(f"{name}: mean slope {slope.mean():.3f} by the backward pass, {wide:.3f} from end to end")
        axes.plot(x, y, color="0.7", linewidth=4, label="simulated")
        for i in range(args.worlds // 12, args.worlds, args.worlds // 6):
            ends = torch.tensor([-0.15, 0.15])
            label = "slope by the backward pass" if i == args.worlds // 12 else None
            axes.plot(x[i] + ends, y[i] + slope[i] * ends, color="tab:red", label=label)
        axes.set(xlabel="speed downwards at the start [m/s]", title=name)
    panels[0].set_ylabel(f"height after {args.steps / 100:g} s [m]")
    panels[0].legend()
    figure.savefig(args.picture, dpi=110)


if __name__ == "__main__":
    main()
