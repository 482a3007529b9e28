# %% [markdown]
# # Muscles
#
# A motor gives the torque that it is told. A muscle does not: its force depends on its length and speed, it can only
# pull, and it answers late. This notebook looks at one muscle that bends an elbow, follows the gradient through it,
# and fits one of its parameters to measurements. It takes a minute on a CPU.

# %%
import matplotlib.pyplot as plt
import mujoco
import numpy as np
import torch

import msk_ray

# %% tags=["parameters"]
ANGLES = 40  # positions of the elbow
STEPS = 30  # control steps of 10 ms
ITERATIONS = 100

# %% [markdown]
# ## The arm
#
# One hinge, a forearm of 1.5 kg, and a biceps from the upper arm to the forearm. MuJoCo's muscle has a peak force
# [N], a range of lengths in which it works, and an activation between 0 and 1 that follows the excitation (its
# control).

# %%
ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><site name="shoulder" pos="0.02 0 0.28"/>
    <body><joint name="elbow" axis="0 -1 0" range="0 140" limited="true" damping="0.3" armature="0.005"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.26" size=".03" mass="1.5" contype="0" conaffinity="0"/>
      <site name="forearm" pos="0.03 0 -0.05"/></body></worldbody>
  <tendon><spatial name="biceps"><site site="shoulder"/><site site="forearm"/></spatial></tendon>
  <actuator><muscle name="biceps" tendon="biceps" force="600" range="0.55 1.25" lengthrange="0.22 0.34" lmin="0.4"
    lmax="1.6" timeconst="0.01 0.04" tausmooth="0.3"/></actuator>
</mujoco>"""
model = mujoco.MjModel.from_xml_string(ARM)
angles = np.linspace(0.05, 2.3, ANGLES)  # of the elbow [rad]; 0 is straight

# %% [markdown]
# ## Force and moment arm
#
# We hold the elbow at each angle and the muscle at three activations. The *moment arm* says how much torque a newton
# of muscle force makes: it is the change of the muscle's length with the joint angle. Force times moment arm is the
# torque.

# %%
data = mujoco.MjData(model)
activations = (0.0, 0.5, 1.0)
length, arm, force = np.zeros(ANGLES), np.zeros(ANGLES), np.zeros((3, ANGLES))
for place, angle in enumerate(angles):
    for row, activation in enumerate(activations):
        mujoco.mj_resetData(model, data)
        data.qpos[0], data.act[0] = angle, activation
        mujoco.mj_forward(model, data)
        force[row, place] = -data.actuator_force[0]
    length[place] = data.actuator_length[0]
    arm[place] = -data.actuator_moment.flat[0]

figure, panels = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
degrees = np.rad2deg(angles)
for row, activation in enumerate(activations):
    panels[0].plot(1000 * length, force[row], label=f"activation {activation}")
    panels[2].plot(degrees, force[row] * arm)
panels[0].set(xlabel="length [mm]", ylabel="force [N]", title="force over length")
panels[0].legend(fontsize=8)
panels[1].plot(degrees, 1000 * arm, "k")
panels[1].set(xlabel="elbow [degrees]", ylabel="moment arm [mm]", title="moment arm")
panels[2].set(xlabel="elbow [degrees]", ylabel="torque [N m]", title="torque = force × moment arm")
plt.show()

# %% [markdown]
# A short muscle is weak: in a bent elbow it pulls with little force, whatever the activation. Without activation
# there is only the passive force of stretching. A policy has to know all this, and its gradient says it.
#
# ## The gradient through activation
#
# A muscle answers late, because activation is a state: it runs after the excitation with a time constant of 10 ms,
# and decays with 40 ms. (`tausmooth` blends between the two times. Without it MuJoCo switches, exactly where an
# activation rests, and there is no slope.) So an excitation works on through the activation that it leaves behind. We
# hold the excitation at 0.3 and ask how the final angle changes with the excitation of each control step. Then we ask
# once more with the activation's gradient cut between control steps, as a simulator does that takes activation for a
# constant.

# %%
sim = msk_ray.Simulation(model, nworld=1, substeps=5)  # control steps of 10 ms


def final_angle(excitation: torch.Tensor, cut: bool = False) -> torch.Tensor:
    """Angle [rad] after all control steps, for excitations (STEPS,)."""
    qpos, qvel, act = sim.initial_state()
    for value in excitation:
        qpos, qvel, act = sim.step(value.reshape(1, 1), qpos, qvel, act.detach() if cut else act)
    return qpos[0, 0]


def slopes(cut: bool) -> torch.Tensor:
    """Its derivative by every excitation (STEPS,)."""
    excitation = torch.full((STEPS,), 0.3, requires_grad=True)
    final_angle(excitation, cut).backward()
    return excitation.grad


whole, without = slopes(cut=False), slopes(cut=True)
probe, change = STEPS // 2, 0.02
ends = []
for sign in (1.0, -1.0):
    excitation = torch.full((STEPS,), 0.3)
    excitation[probe] += sign * change
    ends.append(final_angle(excitation).item())
difference = (ends[0] - ends[1]) / (2 * change)
print(
    f"excitation of step {probe}: gradient {whole[probe]:.4f} rad, difference of two simulations {difference:.4f} rad"
)
print(f"cut between steps, {without.norm() / whole.norm():.0%} of the gradient's norm is left")

figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot(whole, "o-", label="gradient")
axes.plot(without, ".--", label="activation cut between steps")
axes.plot(probe, difference, "k+", markersize=14, label="difference of two simulations")
axes.set(xlabel="control step of the excitation", ylabel="change of the final angle [rad]")
axes.legend()
plt.show()

# %% [markdown]
# Each excitation acts on the angle mostly through the activation that outlives its control step: cut there, most of
# the gradient is gone. `msk_ray` keeps activation as an input and an output of every step, so that none of it is
# lost.
#
# ## Fit a parameter
#
# How strong is this muscle? Suppose somebody measured the elbow's torque at several angles, fully activated, with 1 N
# m of noise, and the true peak force is 760 N. A step takes values of the model's fields (`parameters=`), and gives
# gradients with respect to them. Each measurement is one world: held still, the first step's change of speed shows
# the torque.

# %%
TRUE, NOISE = 760.0, 1.0
torch.manual_seed(0)
count = len(angles)
bench = msk_ray.Simulation(model, nworld=count, substeps=1)
held = torch.tensor(angles, dtype=torch.float32)[:, None]
still, full = torch.zeros(count, 1), torch.ones(count, 1)
FORCE = 2  # place of the peak force among a muscle's parameters


def acceleration(peak: torch.Tensor) -> torch.Tensor:
    """Acceleration of the elbow [rad/s²] at every angle, shape (W,), for a peak force [N]."""
    prm = torch.tensor(model.actuator_gainprm, dtype=torch.float32)
    prm = torch.cat([prm[:, :FORCE], peak.reshape(1, 1), prm[:, FORCE + 1 :]], dim=1)
    # A muscle has its parameters twice: for its active force and for its passive one.
    end = bench.step(full, held, still, full, parameters={"actuator_gainprm": prm, "actuator_biasprm": prm})
    return end.qvel[:, 0] / model.opt.timestep


mujoco.mj_resetData(model, data)
mujoco.mj_forward(model, data)
inertia = float(data.M[0])  # of the elbow [kg m²]
with torch.no_grad():
    measured = inertia * acceleration(torch.tensor(TRUE)) + NOISE * torch.randn(count)
peak = torch.tensor(600.0, requires_grad=True)
optimizer = torch.optim.Adam([peak], lr=10.0)
history = []
for _ in range(ITERATIONS):
    optimizer.zero_grad()
    residual = inertia * acceleration(peak) - measured
    residual.square().mean().backward()
    optimizer.step()
    history.append(peak.item())
print(f"peak force: {history[-1]:.0f} N, true {TRUE:.0f} N; residual {residual.square().mean().sqrt():.2f} N m")

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
left.plot(history)
left.axhline(TRUE, color="0.7", linestyle="--")
left.set(xlabel="iteration", ylabel="peak force [N]")
right.plot(degrees, measured, "o", markersize=3, label="measured")
right.plot(degrees, (inertia * acceleration(peak)).detach(), label="fitted")
right.set(xlabel="elbow [degrees]", ylabel="torque, gravity included [N m]")
right.legend()
plt.show()

# %% [markdown]
# The same works for a muscle's path, its range and its fibres at once, where Gauss-Newton needs fewer iterations:
# [muscle_fit.py](../examples/muscle_fit.py). [Parameters](../step/parameters.md) lists the fields that have gradients,
# and [legs with muscles](../legs/README.md) learn to walk with them.
