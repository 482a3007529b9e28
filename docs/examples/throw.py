"""Throw a ball so that it lands in a bin after one bounce: gradient descent on the throw, through the contact."""

import matplotlib.pyplot as plt
import mujoco
import torch

from msk_ray.step import Simulation, TapePerSubstep

model = mujoco.MjModel.from_xml_string("""
<mujoco><option timestep="0.005" cone="elliptic"/><worldbody>
  <geom type="plane" size="5 5 1" solref="-2000 -2" friction="0.4"/>
  <body pos="0 0 1"><freejoint/><geom size="0.1" mass="0.2" solref="-2000 -2" friction="0.4"/></body>
</worldbody></mujoco>""")
sim = Simulation(model, nworld=1, substeps=4, backward=TapePerSubstep(), device="cpu")
target = torch.tensor([[2.5, 0.0, 0.8]])  # where the ball shall be after 1.2 seconds
throw = torch.tensor([[1.0, 0.3, 0.0]], requires_grad=True)  # initial velocity [m/s]
optimizer = torch.optim.Adam([throw], lr=0.1)
for iteration in range(81):
    qpos, qvel, act = sim.initial_state()
    qvel = torch.cat((throw, qvel[:, 3:]), dim=-1)
    path = [qpos]
    for _ in range(60):
        qpos, qvel, act = sim.step(torch.zeros(1, 0), qpos, qvel, act)
        path.append(qpos)
    loss = (qpos[:, :3] - target).square().sum()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if iteration % 20 == 0:
        print(f"iteration {iteration}: {loss.sqrt().item():.3f} m off, thrown at {throw.detach().numpy().round(2)[0]}")
        x, z = torch.cat(path).detach()[:, [0, 2]].T
        plt.plot(x, z, color=plt.cm.viridis(iteration / 100), label=f"iteration {iteration}")
plt.plot(*target[0, [0, 2]], "k*", markersize=14, label="target")
plt.axhline(0.1, color="0.6", linewidth=1)
plt.xlabel("x [m]"), plt.ylabel("height [m]"), plt.legend(), plt.gca().set_aspect("equal")
plt.savefig("throw.png", dpi=110, bbox_inches="tight")
print("drawn in throw.png")
