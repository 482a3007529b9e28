# %% [markdown]
# # The gradient of a bouncing ball
#
# A policy that learns through a simulator follows the simulator's gradient. This notebook shows on the smallest
# example, a ball, what that gradient is, when it can be trusted, and what soft contacts and short horizons have to do
# with it. It needs no knowledge of optimal control, and takes a few minutes on a CPU.

# %%
import matplotlib.pyplot as plt
import mujoco
import torch

import msk_ray

# %% tags=["parameters"]
WORLDS = 121  # balls thrown side by side
STEPS = 60  # of 10 ms
ITERATIONS = 8
FALL = 100  # steps of 10 ms of the last experiment

# %% [markdown]
# ## A ball and a floor
#
# The ball starts 1 m above the floor and is thrown down. `solimp` says how a contact's force grows with depth: with
# MuJoCo's default it jumps as soon as ball and floor touch, with `0 0.95 0.05` it grows from zero over 5 cm. The
# `solref` makes both bounce.

# %%
BALL = """
<mujoco><option timestep=".001" integrator="implicitfast"/>
  <default><geom solref="-2000 -2" solimp="{solimp}"/></default>
  <worldbody><geom type="plane" size="1 1 .1"/>
    <body pos="0 0 1"><joint type="slide" axis="0 0 1"/><geom type="sphere" size=".1" mass="1"/></body></worldbody>
</mujoco>"""
HARD, SOFT = "0.9 0.95 0.001", "0 0.95 0.05"


def throw(speed: torch.Tensor, solimp: str, steps: int) -> torch.Tensor:
    """Heights [m], shape (steps, W), of balls thrown down with speeds (W,) [m/s], one in each world."""
    model = mujoco.MjModel.from_xml_string(BALL.format(solimp=solimp))
    sim = msk_ray.Simulation(model, nworld=len(speed), substeps=10)
    qpos, qvel, act = sim.initial_state()
    qvel = qvel - speed[:, None]
    no_control = torch.zeros(len(speed), 0)
    heights = []
    for _ in range(steps):
        qpos, qvel, act = sim.step(no_control, qpos, qvel, act)
        heights.append(1.0 + qpos[:, 0])
    return torch.stack(heights)


# %% [markdown]
# Three throws. Both floors return the ball almost alike; the soft one lets it in deeper.

# %%
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
for solimp, style, name in ((HARD, "-", "force jumps"), (SOFT, "--", "force grows")):
    paths = throw(torch.tensor([0.5, 1.5, 2.5]), solimp, STEPS)
    for world in range(3):
        label = name if world == 0 else None
        axes.plot(0.01 * torch.arange(1, STEPS + 1), paths[:, world], style, color=f"C{world}", label=label)
axes.axhline(0.1, color="0.8")
axes.set(xlabel="time [s]", ylabel="height [m]")
axes.legend()
plt.show()

# %% [markdown]
# ## What the gradient says
#
# The height at the end is a function of the speed at the start. `backward()` gives the slope of that function for
# every ball in one pass back through all steps. If the slopes are right, the red lines are tangents of the grey
# curve.

# %%
figure, panels = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
slopes = {}
for axes, (solimp, name) in zip(panels, ((HARD, "force jumps at touch"), (SOFT, "force grows from zero")), strict=True):
    speed = torch.linspace(0.0, 3.0, WORLDS, requires_grad=True)
    height = throw(speed, solimp, STEPS)[-1]
    height.sum().backward()  # the height of each ball depends on its own speed alone
    slopes[name] = speed.grad
    x, y = speed.detach(), height.detach()
    mean = float((y[-1] - y[0]) / (x[-1] - x[0]))
    print(f"{name}: the gradient says {speed.grad.mean():.2f} m per m/s, the curve's ends {mean:.2f}")
    axes.plot(x, y, color="0.7", linewidth=4)
    for i in range(WORLDS // 12, WORLDS, max(1, WORLDS // 6)):
        ends = torch.tensor([-0.15, 0.15])
        axes.plot(x[i] + ends, y[i] + speed.grad[i] * ends, color="tab:red")
    axes.set(xlabel="speed downwards [m/s]", title=name)
panels[0].set_ylabel("height at the end [m]")
plt.show()

# %% [markdown]
# On the left, the gradient is about twice as steep as the curve. It is not wrong: look closely at the curve's fine
# teeth, which do have that slope. A faster ball touches the floor earlier, but the simulator notices only at its next
# step, of 1 ms; until then, the force that jumped is missing. Now and then the contact moves to the step before, and
# the curve falls back. The gradient sees the teeth and never their edges.
#
# Smaller steps make finer teeth with the same slope. A force that grows from zero has no teeth.
#
# ## Does it matter?
#
# We look for the speed after which the ball is at 0.6 m at the end, by Newton's method: follow the tangent to the
# height that we want, simulate, repeat.


# %%
def aim(solimp: str, target: float) -> list[float]:
    """Distance from the target [m] before each iteration."""
    speed, errors = torch.tensor([1.0]), []
    for _ in range(ITERATIONS):
        speed.requires_grad_()
        error = throw(speed, solimp, STEPS)[-1] - target
        (slope,) = torch.autograd.grad(error.sum(), speed)
        errors.append(abs(error.item()))
        speed = (speed - error / slope).detach()
    return errors


errors = {name: aim(solimp, 0.6) for solimp, name in ((HARD, "force jumps"), (SOFT, "force grows"))}
figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
for name, values in errors.items():
    axes.semilogy(values, "o-", label=name)
    print(f"{name}: {1000 * values[-1]:.2f} mm from the target after {ITERATIONS - 1} iterations")
axes.set(xlabel="iteration", ylabel="distance from the target [m]")
axes.legend()
plt.show()

# %% [markdown]
# With the right slope, a few iterations suffice. With slopes twice too steep, each step goes half as far as it
# should. Here that is only slow; where steep slopes of several contacts multiply, the sign may be wrong too.
#
# In `msk_ray`, `physics.solimp` and `physics.solref` of a trial set the contacts that a policy learns on, and
# `msk-ray evaluate --physics` scores it on others.
#
# ## Why horizons are short
#
# Now the ball falls through rows of pins. Each pin it hits sends it somewhere else, and a small difference at the
# start grows with every hit. We ask for the gradient of its sideways position with respect to where it started,
# after more and more steps.

# %%
ROWS, APART, PIN = 4, 0.25, 0.05
pins = [(APART * (place + 0.5 * (row % 2)), 0.9 - 0.22 * row) for row in range(ROWS) for place in range(-4, 5)]
spheres = "".join(f'<geom size="{PIN}" pos="{x} 0 {z}"/>' for x, z in pins)
BOARD = f"""
<mujoco><option timestep=".001" integrator="implicitfast"/>
  <default><geom type="sphere" solref="-40000 -20" solimp="0 0.95 0.02" condim="1"/></default>
  <worldbody>{spheres}
    <body pos="0 0 1.2"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <geom size=".04" mass="1"/></body>
  </worldbody>
</mujoco>"""
BALLS = 32
sim = msk_ray.Simulation(mujoco.MjModel.from_xml_string(BOARD), nworld=BALLS, substeps=10)
qpos, qvel, act = sim.initial_state()
start = torch.linspace(0.01, 0.04, BALLS, requires_grad=True)  # metres to the side, one world each
qpos = torch.stack([start, qpos[:, 1]], dim=1)
path = []
for _ in range(FALL):
    qpos, qvel, act = sim.step(torch.zeros(BALLS, 0), qpos, qvel, act)
    path.append(qpos)
seen = range(9, FALL, 10)
slopes_by_time = torch.stack(
    [torch.autograd.grad(path[step][:, 0].sum(), start, retain_graph=True)[0].abs() for step in seen]
)

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for x, z in pins:
    left.add_patch(plt.Circle((x, z), PIN, color="0.75"))
for world in (BALLS // 2, BALLS // 2 + 1, BALLS // 2 + 2):
    track = torch.stack(path)[:, world].detach()
    left.plot(track[:, 0], 1.2 + track[:, 1], label=f"{1000 * start[world]:.1f} mm")
left.set(xlabel="sideways [m]", ylabel="height [m]", xlim=(-0.8, 0.8), ylim=(0.1, 1.25), aspect="equal")
left.legend(title="started at", fontsize=8, loc="lower right")
time = [0.01 * (step + 1) for step in seen]
right.semilogy(time, slopes_by_time.median(dim=1).values, label=f"median of {BALLS} balls")
right.semilogy(time, slopes_by_time.max(dim=1).values, label="largest")
right.set(xlabel="time [s]", ylabel="size of the gradient [m per m]")
right.legend()
plt.show()
last = slopes_by_time[-1]
print(f"after {time[-1]:.1f} s: median {last.median():.0f}, largest {last.max():.0f} metres per metre")

# %% [markdown]
# After a few pins, a millimetre at the start has become metres. The gradient is still the right slope, but of a curve
# so folded that its slope says nothing about where to go, and the largest of many gradients decides their mean.
#
# That is why SHAC, the algorithm that `msk_ray` trains with, simulates only 8 to 32 steps at a time and lets a second
# network, the critic, judge what comes after; why it averages over thousands of worlds; and why
# `shac.state_grad_clip` bounds what one world may contribute. The next notebook [trains with it](sweep.ipynb).
